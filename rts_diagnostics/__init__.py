"""Diagnostics of derivatives: finite differences to compare with, pictures, and reasons for disagreement."""

"""Samplers, engines and compiled splatters that come with the library, a file or folder each; and shared loops."""

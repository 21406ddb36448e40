"""Derivatives of images, and images, against ground truth."""

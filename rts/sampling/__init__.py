"""The step without derivative: where rays meet surfaces, as packed samples."""

"""The experiments of the paper, each with a figure and an animation."""

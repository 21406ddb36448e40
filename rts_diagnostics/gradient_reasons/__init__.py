"""Reasons why derivatives disagree with the truth, or vanish, from experiments on a scene."""

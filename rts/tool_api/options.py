"""Texts of options, as commands take them, and what they mean."""

from rts.errors import InputError, InputWarning, warn

__all__ = ["size_of", "supersample_of"]


def size_of(text: str) -> tuple[int, int]:
    """(height, width) in pixels of an option's text: "256" for a square, or "640x480", WIDTHxHEIGHT.

    Raises:
        InputError: the text is no size.

    Warns:
        InputWarning: the sides differ, and until 0.3 the first one was the height. The warning goes in 0.4.
    """
    sides = text.lower().split("x")
    if len(sides) not in (1, 2) or not all(side.strip().isdecimal() and int(side) > 0 for side in sides):
        raise InputError(f"{text!r} is no size; expected a number of pixels, or WIDTHxHEIGHT such as 640x480")
    width, height = int(sides[0]), int(sides[-1])
    if width != height:
        warn(f"size {text} is {width} wide and {height} high; before rts 0.3 the height came first", InputWarning)
    return height, width


def supersample_of(text: str) -> int:
    """The `supersample` of `rts.render` that is written as a text, such as "4".

    Raises:
        InputError: the text is no number.
    """
    if not text.strip().isdecimal():
        raise InputError(
            f"{text!r} is no supersample; expected a number of samples along each side of a pixel, such as 4. Splatter "
            f"'edges', the default, finds outlines with 1"
        )
    return int(text)

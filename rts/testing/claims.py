"""How a claim of the kit fails, and with what words."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from rts.arrays.trees import leaves
from rts.errors import RtsError


def claim(holds: Any, message: str) -> None:
    """Fail with a message unless something holds; plain asserts of installed packages say nothing of their values."""
    if not holds:
        raise AssertionError(message)


def claim_close(found: Any, expected: Any, tolerance: float, what: str) -> None:
    """Fail unless two arrays of one shape differ by at most a tolerance, absolutely."""
    found, expected = np.asarray(found), np.asarray(expected)
    claim(found.shape == expected.shape, f"{what} has shape {found.shape}; expected {expected.shape}")
    worst = np.abs(found - expected).max(initial=0)
    claim(worst <= tolerance, f"{what} is off by {worst:.3g}; expected at most {tolerance:.3g}")


def claim_finite(tree: Any, what: str) -> None:
    """Fail if any array of a tree holds NaN or infinity."""
    for x in leaves(tree):
        claim(np.isfinite(x).all(), f"{what} has {np.sum(~np.isfinite(x))} values that are NaN or infinite")


@contextlib.contextmanager
def no_error(what: str) -> Iterator[None]:
    """Turn an error into a failed claim that says what was being done."""
    try:
        yield
    except AssertionError:
        raise
    except Exception as error:
        raise AssertionError(f"{what}: {type(error).__name__}: {error}") from error


def refusal(call: Callable[[], Any], what: str) -> str | None:
    """The message with which a call refuses its input, or None where it accepts it.

    Raises:
        AssertionError: the error is none of `rts.RtsError`, or its message is not one line.
    """
    try:
        call()
    except RtsError as error:
        message = str(error)
        one_line = message.strip() and "\n" not in message
        claim(one_line, f"{what}: the error must be one line that says what to do; it is {message!r}")
        return message
    except Exception as error:
        raise AssertionError(f"{what}: {type(error).__name__} ({error}); expected an rts.InputError") from error
    return None

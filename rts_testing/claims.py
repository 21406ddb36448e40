"""Claims of the kit: assertions that fail with a message."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from rts.errors import RtsError
from rts.plugin_api.arrays import leaves


def claim(holds: Any, message: str) -> None:
    """Fail with a message unless a condition holds; pytest shows no values for plain asserts in installed packages."""
    if not holds:
        raise AssertionError(message)


def claim_close(actual: Any, expected: Any, tolerance: float, what: str) -> None:
    """Fail unless two arrays of one shape differ by at most a tolerance, absolutely."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    claim(actual.shape == expected.shape, f"{what} has shape {actual.shape}; expected {expected.shape}")
    worst = np.abs(actual - expected).max(initial=0)
    claim(worst <= tolerance, f"{what} is off by {worst:.3g}; expected at most {tolerance:.3g}")


def claim_finite(tree: Any, what: str) -> None:
    """Fail if any array of a tree holds NaN or infinity."""
    for x in leaves(tree):
        claim(np.isfinite(x).all(), f"{what} has {np.sum(~np.isfinite(x))} values that are NaN or infinite")


@contextlib.contextmanager
def no_error(what: str) -> Iterator[None]:
    """Turn an error into a failed claim whose message says what was tried."""
    try:
        yield
    except AssertionError:
        raise
    except Exception as error:
        raise AssertionError(f"{what}: {type(error).__name__}: {error}") from error


def refusal(call: Callable[[], Any], what: str) -> str | None:
    """The message with which a call refuses its input; None if it accepts it.

    Raises:
        AssertionError: the error is not an `rts.RtsError`, or its message is not one line.
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

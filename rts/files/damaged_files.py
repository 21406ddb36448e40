"""Errors for damaged files, and the warnings gathered while a file is read."""

from __future__ import annotations

import contextlib
import logging
import re
import threading
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

from rts import errors
from rts.errors import FileWarning, InputError

Fail = Callable[[str], InputError]
"""A fault of a file, in words → the error."""
COUNT = re.compile(r"\+?[0-9]+")
"""A count in a header. Python's own rules take digits of any script."""
_PLAIN = b"\t" + bytes(range(32, 127))
_COMMENT = re.compile(r"(?<!\.)#.*")
_ONE_AT_A_TIME = threading.RLock()  # Filters of warnings belong to the whole process.


def unreadable(path: Path, kind: str, what: str) -> InputError:
    """The error of a file that is damaged, or of another format than its name says."""
    return InputError(
        f"{path} cannot be read as {kind} ({what}); the file may be cut short or of another format: export it again"
    )


def contents(path: Path) -> bytes:
    """The bytes of a file; an InputError where it cannot be read."""
    try:
        return path.read_bytes()
    except (OSError, MemoryError) as error:
        reason = getattr(error, "strerror", None) or "it does not fit into memory"
        raise InputError(f"{path} cannot be read ({reason}); check the file and who may read it") from error


def text_of(path: Path, kind: str, data: bytes) -> str:
    """A file's text; an InputError if the bytes are no UTF-8."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path} is not a valid {kind} file, neither as binary nor as text; the file may be cut short or of "
            "another format: export it again"
        ) from error


def lines_of(data: bytes) -> list[str]:
    """The lines of a text. They end in LF, CR LF or CR; Unicode's other ends of lines are no ends here."""
    text = data.decode("utf-8-sig", "replace")
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def without_comment(line: str) -> str:
    """The line up to its "#". In 1.#QNAN, as C once wrote NaN, there is no comment."""
    return _COMMENT.sub("", line) if "#" in line else line


def is_plain(text: str) -> bool:
    """True for ASCII, spaces and tabs. Python reads numbers in digits of any script, between spaces of any kind."""
    return text.isascii() and not text.encode().translate(None, _PLAIN)


@contextlib.contextmanager
def gathered(path: Path) -> Iterator[list[str]]:
    """Gather warnings about a file: a list that holds a line for each different one in the block, once the block ends.

    Other libraries warn in their own ways, and trimesh only logs: their messages are caught, and get the name of the
    file. Warnings of deprecations and of files left open are dropped. Threads take turns.

    Raises:
        InputError: NumPy came upon text among numbers.
    """
    lines: list[str] = []
    handler = _Lines(path, lines)
    logger = logging.getLogger("trimesh")
    with _ONE_AT_A_TIME:
        propagated, logger.propagate = logger.propagate, False
        logger.addHandler(handler)
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                yield lines
        finally:
            logger.removeHandler(handler)
            logger.propagate = propagated
    for warning in caught:
        text = " ".join(str(warning.message).split())
        if "unmatched data" in text:
            raise unreadable(path, path.suffix[1:].upper(), "there is text where numbers ought to be")
        if issubclass(warning.category, FileWarning):
            lines.append(text)
        elif not issubclass(warning.category, (DeprecationWarning, PendingDeprecationWarning, ResourceWarning)):
            lines.append(f"{path}: {text}; check what was loaded")
    lines[:] = dict.fromkeys(lines)


def warn_once(path: Path, lines: list[str]) -> None:
    """Pass what was `gathered` on to the user, as one warning."""
    if lines:
        rest = (line.removeprefix(str(path)).lstrip(":, ") for line in lines[1:])
        errors.warn("; ".join([lines[0], *rest]), FileWarning)


class _Lines(logging.Handler):
    """Handler that adds lines for records logged as warnings or worse, with the errors that led to them."""

    def __init__(self, path: Path, lines: list[str]):
        super().__init__(logging.WARNING)
        self.path, self.lines = path, lines

    def emit(self, record: logging.LogRecord) -> None:
        """Add a line."""
        error = record.exc_info[1] if record.exc_info else None
        reason = f" ({type(error).__name__}: {error})" if error is not None else ""
        text = " ".join(f"{record.getMessage()}{reason}".split())
        self.lines.append(f"{self.path}: {text}; check what was loaded")


def warn(text: str) -> None:
    """Warn of a file; call it inside `gathered`, which passes the warning on to the user."""
    errors.warn(text, FileWarning)

"""Measurements kept in a file, one a line, so that an interrupted run goes on where it stopped."""

from __future__ import annotations

import datetime
import json
from pathlib import Path
from typing import Any

from rts.errors import InputError
from rts.tool_api.files import writing


class KeptMeasurements:
    """A table of measurements, each written to a file as soon as it is made.

    Args:
        path: the file, JSON lines; None to keep the table in memory alone. An incomplete last line is
            removed from the file.

    Attributes:
        since: the date of the oldest measurement that `get` has returned, ISO 8601; today without any.

    Raises:
        InputError: the file cannot be read or written, or a line of it is no measurement.
    """

    def __init__(self, path: Path | None = None):
        self.path, self._kept = path, {}
        self.since = datetime.date.today().isoformat()
        if path is None:
            return
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            text = path.read_bytes() if path.exists() else b""
            whole = text[: text.rfind(b"\n") + 1]
            if len(whole) < len(text):
                path.write_bytes(whole)
        for number, line in enumerate(whole.decode("utf-8", "replace").splitlines(), 1):
            try:
                key, value, date = json.loads(line)
                self._kept[key] = value, date
            except (ValueError, TypeError) as error:
                raise InputError(f"line {number} of {path} is no measurement; remove the file to start anew") from error

    def get(self, *key: Any) -> Any:
        """The value kept under a key; None if there is none."""
        value, date = self._kept.get(_text(key), (None, self.since))
        self.since = min(self.since, date)
        return value

    def put(self, value: Any, *key: Any) -> Any:
        """Keep a value of types that JSON has under a key; return the value."""
        text, date = _text(key), datetime.date.today().isoformat()
        self._kept[text] = value, date
        if self.path is not None:
            with writing(self.path), self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps([text, value, date]) + "\n")
        return value

    def __len__(self) -> int:
        return len(self._kept)


def _text(key: tuple) -> str:
    return json.dumps(key)

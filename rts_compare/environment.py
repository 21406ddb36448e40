"""Conditions of measurements beside the code: the date, the machine, the versions of packages."""

from __future__ import annotations

import datetime
import os
import platform
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from typing import Any


def environment(packages: Iterable[str]) -> dict[str, Any]:
    """The date, the machine, and the version of each package; None for a package that is not installed."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    machine = f"{count} cores, {platform.machine()}, {platform.system()}, Python {platform.python_version()}"
    return {
        "date": datetime.date.today().isoformat(),
        "machine": machine,
        "versions": {package: _version(package) for package in packages},
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None

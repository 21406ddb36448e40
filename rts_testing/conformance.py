"""The base of the kit's classes: pytest collects only subclasses of them made outside the kit."""

from __future__ import annotations

from typing import Any

import pytest


class Conformance:
    """Base of the kit's classes: only subclasses made outside the kit are collected by pytest."""

    __test__ = False
    pytestmark = pytest.mark.filterwarnings(
        "ignore::rts.errors.EmptyImageWarning"
    )  # The kit renders empty images, too.

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "__test__" not in cls.__dict__:
            cls.__test__ = not cls.__module__.startswith("rts_testing.")

"""Temporary."""

from rts.threads import *  # noqa: F403
from rts.threads import _lock, _pool, _pools  # noqa: F401

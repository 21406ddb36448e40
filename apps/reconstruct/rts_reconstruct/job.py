"""One process, or a job of several that `torchrun` starts, whose first one writes."""

from __future__ import annotations

import atexit
import os
from collections.abc import Callable
from typing import Any

import torch

# Forward derivatives import this module. Its default arguments would hold a group that was made before.
import torch.distributed.nn


def join() -> bool:
    """Join the job of `torchrun`, if there is one. Returns True in its first process, and where there is no job."""
    if "RANK" in os.environ and not torch.distributed.is_initialized():
        # torch may abort a process whose group still has threads when it ends.
        torch.distributed.init_process_group("gloo")
        atexit.register(torch.distributed.destroy_process_group)
    return first()


def first() -> bool:
    """True in the first process of a job, and where there is no job."""
    return not torch.distributed.is_initialized() or torch.distributed.get_rank() == 0


def shared(function: Callable[[], Any]) -> Any:
    """The result of a function that the first process alone calls.

    The function may not fit to views: processes share those, and this one would wait for the others.
    """
    if not torch.distributed.is_initialized():
        return function()
    results = [function() if first() else None]
    torch.distributed.broadcast_object_list(results)
    return results[0]

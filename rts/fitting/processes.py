"""Several processes that share the terms of a fit, as `torchrun` starts them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from rts.errors import RtsError
from rts.fitting.parameter_names import one_line
from rts.fitting.run import Astray


class Processes:
    """The processes of a job of `torch.distributed`.

    Attributes:
        rank: the number of this process.
        count: the number of processes.
    """

    def __init__(self, distributed: Any):
        self._distributed = distributed
        self.rank, self.count = distributed.get_rank(), distributed.get_world_size()
        # NCCL knows only arrays on GPUs.
        self._device = "cuda" if distributed.get_backend() == "nccl" else "cpu"

    @classmethod
    def joined(cls) -> Processes | None:
        """The job that this process has joined by `torch.distributed.init_process_group`; None if there is no other."""
        distributed = sys.modules.get("torch.distributed")
        if distributed is None or not distributed.is_available() or not distributed.is_initialized():
            return None
        return cls(distributed) if distributed.get_world_size() > 1 else None

    def share(self, items: Sequence[Any]) -> Sequence[Any]:
        """The items that this process computes: every `count`-th."""
        return items[self.rank :: self.count]

    def in_order(self, vectors: Sequence[np.ndarray], total: int, failure: Exception | None) -> list[np.ndarray]:
        """Vectors of all items, in their order, in every process.

        Args:
            vectors: float64, one for each item of the own `share`.
            total: the number of items.
            failure: the error that ended the own computation. Every process then raises it.

        Raises:
            Astray: the fit went astray in one of the processes.
            RtsError: another error, here or in another process; or a process has ended.
        """
        width = max((len(v) for v in vectors), default=0)
        states = self._gathered(np.array([failure is not None, width], np.int64))
        if states[:, 0].any():
            self._raise(failure)
        rows = np.zeros((-(-total // self.count), states[:, 1].max()))
        for row, vector in zip(rows, vectors, strict=False):
            row[:] = vector
        gathered = self._gathered(rows)
        return [gathered[k % self.count, k // self.count] for k in range(total)]

    def agreed(self, value: Any) -> Any:
        """The first process's value, in every process."""
        values = [value]
        self._tried(self._distributed.broadcast_object_list, values, src=0)
        return values[0]

    def _raise(self, failure: Exception | None) -> None:
        messages: list[Any] = [None] * self.count
        report = None if failure is None else (isinstance(failure, Astray), str(failure))
        self._tried(self._distributed.all_gather_object, messages, report)
        if failure is not None:
            raise failure
        rank, (astray, message) = next((i, m) for i, m in enumerate(messages) if m is not None)
        raise Astray(message) if astray else RtsError(f"process {rank} of {self.count} failed: {one_line(message)}")

    def _gathered(self, array: np.ndarray) -> np.ndarray:
        """Arrays of all processes, stacked."""
        import torch

        tensor = torch.from_numpy(np.ascontiguousarray(array)).to(self._device)
        arrays = [torch.empty_like(tensor) for _ in range(self.count)]
        self._tried(self._distributed.all_gather, arrays, tensor)
        return torch.stack(arrays).cpu().numpy()

    def _tried(self, call: Any, *args: Any, **options: Any) -> None:
        try:
            call(*args, **options)
        except RuntimeError as error:  # Of which torch.distributed raises several kinds.
            raise RtsError(
                f"process {self.rank} of {self.count} waited for the others, and one has ended "
                f"({one_line(str(error), 100)}); its own message says why"
            ) from None

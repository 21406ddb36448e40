"""Functions of tensors and samples as compiled programs: traced by `torch.export`, compiled by `torch.compile`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils import _pytree

from rts import InputError, RtsError
from rts.plugin_api.arrays import Tree, exemplar, map_leaves


class Programs:
    """A function of trees that traces and compiles another one for each kind of arguments, and keeps the programs.

    Args:
        f: the function.
        varying: arguments → a tree like them, with the axis of each array that may have another length, −1 for none.
        options: of `torch.compile`.
        constant: (an array of NumPy, a tensor) → the array as a tensor beside it.
    """

    def __init__(self, f: Callable, varying: Callable[[Tree], Tree], options: Mapping[str, Any], constant: Callable):
        if not hasattr(torch.export.Dim, "AUTO"):
            raise InputError(f"rts.program needs torch 2.6 or later, and this is {torch.__version__}: call f itself")
        self._f, self._varying, self._options, self._constant = f, varying, options, constant
        self._programs: list[_Program] = []

    def __call__(self, *args: Tree) -> Tree:
        """The result of the function, by its program for such arguments."""
        args = map_leaves(lambda x: x, args)  # Mappings of any class as dicts, which torch's trees know.
        found, structure = _pytree.tree_flatten(args)
        like = exemplar(args)
        found = [self._constant(x, like) if isinstance(x, np.ndarray) else x for x in found]
        tensors = [x for x in found if isinstance(x, Tensor)]
        others = [
            _TENSOR if isinstance(x, Tensor) else (type(x), repr(x) if isinstance(x, float) else x) for x in found
        ]
        on = tensors[0].device.type
        modes = torch.is_grad_enabled(), torch.is_autocast_enabled(on) and torch.get_autocast_dtype(on)
        kind = structure, others, [(x.dtype, x.device, x.requires_grad) for x in tensors], modes
        for program in self._programs:
            if program.kind == kind and program.takes(tensors):
                return program.call(tensors)
        axes = structure.flatten_up_to(self._varying(args))
        free = [axis for axis, x in zip(axes, others, strict=True) if x is _TENSOR]
        program = self._traced(kind, [x if x is _TENSOR else found[i] for i, x in enumerate(others)], tensors, free)
        # Else torch takes lengths that are equal now to be equal always, and compiles anew where they are not.
        # Its manual has this function, for all its module's name.
        for x, shape, axis in zip(tensors, program.shapes, free, strict=True):
            if axis >= 0 and isinstance(shape[axis], str):
                torch._dynamo.mark_dynamic(x, axis)
        result = program.call(tensors)
        self._programs.append(program)
        return result

    def _traced(self, kind: tuple, others: list, tensors: list[Tensor], free: Sequence[int]) -> _Program:
        """The program for arguments of a kind, whose leaves are `others` and tensors.

        The axis `free` of each tensor may have another length, if it is not −1.
        """
        structure = kind[0]

        def called(given: Sequence[Tensor]) -> Tree:
            rest = iter(given)
            return self._f(*_pytree.tree_unflatten([next(rest) if x is _TENSOR else x for x in others], structure))

        lengths = [{} if axis < 0 else {axis: torch.export.Dim.AUTO} for axis in free]
        try:
            traced = torch.export.export(_Module(called), (tensors,), dynamic_shapes=(lengths,), strict=False)
        except RtsError:
            raise
        except Exception as error:  # torch has many kinds.
            what = " ".join(str(error).split())[:120]
            raise InputError(
                f"torch cannot trace the function of rts.program ({type(error).__name__}: {what}); expected one that "
                f"asks for no value of its arguments: call rts.sample before it, and pass the result"
            ) from error
        for x in (*traced.state_dict.values(), *traced.constants.values()):
            if isinstance(x, Tensor) and x.requires_grad:
                raise InputError(
                    f"the function of rts.program closes over a tensor of shape {tuple(x.shape)} that requires a "
                    f"gradient; expected it among the arguments, which have derivatives"
                )
        inputs = [node for node in traced.graph.nodes if node.name in traced.graph_signature.user_inputs]
        shapes = [tuple(n if type(n) is int else str(n) for n in node.meta["val"].shape) for node in inputs]
        limits = {str(name): (int(max(r.lower, 2)), r.upper) for name, r in traced.range_constraints.items()}
        return _Program(kind, shapes, limits, torch.compile(traced.module(), **{"dynamic": True, **self._options}))


_TENSOR = object()
"""Stands for a tensor among leaves."""


class _Module(torch.nn.Module):
    """A function of tensors as a module, which `torch.export` takes."""

    def __init__(self, f: Callable[[Sequence[Tensor]], Tree]):
        super().__init__()
        self._f = f

    def forward(self, tensors: Sequence[Tensor]) -> Tree:
        return self._f(tensors)


class _Program(NamedTuple):
    """A compiled function of tensors.

    Attributes:
        kind: what else has to be the same: structure of the arguments, other leaves, dtypes, devices, gradients, modes.
        shapes: the shape of each tensor; lengths that may change have names.
        limits: the least and the largest length of each name: `f` may ask whether there are many.
        call: tensors → a tree.
    """

    kind: tuple
    shapes: Sequence[tuple[int | str, ...]]
    limits: Mapping[str, tuple[int, Any]]
    call: Callable[[Sequence[Tensor]], Tree]

    def takes(self, tensors: Sequence[Tensor]) -> bool:
        """True if tensors have these shapes. Lengths of one name are the same, and within its limits."""
        named: dict[str, int] = {}
        for shape, x in zip(self.shapes, tensors, strict=True):
            if len(shape) != x.ndim:
                return False
            for length, here in zip(shape, x.shape, strict=True):
                if isinstance(length, str):
                    least, most = self.limits.get(length, (2, math.inf))
                    length = named.setdefault(length, here) if least <= here <= most else -1
                if length != here:
                    return False
        return True

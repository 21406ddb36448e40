"""Optimisers of torch.optim as step functions, for `rts.fit`."""

from __future__ import annotations

import copy
import io
import math
import zipfile
from collections.abc import Sequence
from typing import Any

import torch

from rts import InputError
from rts.plugin_api.arrays import Tree, leaves, map_leaves

STATE = {"state": dict, "param_groups": list}
"""Entries of an optimiser's state, and their types."""


class Optimizer:
    """A step function `(parameters, gradient) -> parameters` of a torch optimiser on private copies of tensors.

    Args:
        method: "adam", "sgd", or a `torch.optim.Optimizer` of the tensors in `given`. The optimiser itself stays as it
            is: a copy steps. Tensors that it does not hold keep their values.
        rates: the learning rate, or a list of one for each tensor, for a method by name.
        parameters: where to start.
        given: a tree like `parameters`, whose tensors the optimiser was made for.

    Raises:
        InputError: an optimiser of other tensors, or one that needs a function of the loss (LBFGS).
    """

    def __init__(
        self, method: str | torch.optim.Optimizer, rates: float | Sequence[float], parameters: Tree, original: Tree
    ):
        self._variables = [p.detach().clone() for p in leaves(parameters)]
        if isinstance(method, str):
            kind = {"adam": torch.optim.Adam, "sgd": torch.optim.SGD}[method]
            each = rates if isinstance(rates, Sequence) else [rates] * len(self._variables)
            groups = [{"params": [v], "lr": rate} for v, rate in zip(self._variables, each, strict=True)]
            self._optimizer = kind(groups, lr=each[0])
        else:
            self._optimizer = self._copied(method, list(leaves(original)))
        self._like = parameters

    def _copied(self, method: torch.optim.Optimizer, tensors: Sequence[torch.Tensor]) -> torch.optim.Optimizer:
        """A copy of an optimiser, its state included, that steps the private tensors."""
        if isinstance(method, torch.optim.LBFGS):
            raise InputError('method is LBFGS, which evaluates the loss by itself; use Adam, or method="lm"')
        places = {id(x): i for i, x in enumerate(tensors)}
        held = [p for group in method.param_groups for p in group["params"]]
        if not held or any(id(p) not in places for p in held):
            raise InputError(
                "method is an optimiser of other tensors than those in parameters; make it of the same tensors, such "
                'as torch.optim.Adam([parameters["vertices"]], lr=0.01)'
            )
        optimizer = copy.deepcopy(method)
        copies = [p for group in optimizer.param_groups for p in group["params"]]
        for new, old in zip(copies, held, strict=True):
            place = places[id(old)]
            new.requires_grad_(False).copy_(self._variables[place])
            self._variables[place] = new
        return optimizer

    def __call__(self, _: Tree, gradient: Tree) -> Tree:
        """The parameters after a step from those returned last; the first argument is not read."""
        for variable, g in zip(self._variables, leaves(gradient), strict=True):
            variable.grad = g
        with torch.no_grad():
            self._optimizer.step()
        copies = iter([v.clone() for v in self._variables])
        return map_leaves(lambda _: next(copies), self._like)

    def state(self) -> bytes:
        """Moments and settings, as `torch.save` writes them."""
        file = io.BytesIO()
        torch.save(self._optimizer.state_dict(), file)
        return file.getvalue()

    def restore(self, state: bytes, parameters: Tree) -> None:
        """Go on from a `state` and the parameters that belong to it.

        Raises:
            InputError: the state is damaged, or of another optimiser.
        """
        known = _unpacked(state)
        if not self._fits(known):
            raise InputError("the state of its optimiser is damaged, or of another optimiser")
        self._optimizer.load_state_dict(known)
        for variable, value in zip(self._variables, leaves(parameters), strict=True):
            variable.copy_(value)

    def _fits(self, known: Any) -> bool:
        """True if a state has the settings of this optimiser, and for each tensor what a step leaves there."""
        if not isinstance(known, dict) or not all(isinstance(known.get(key), kind) for key, kind in STATE.items()):
            return False
        stepped = copy.deepcopy(self._optimizer)
        for group in stepped.param_groups:
            for p in group["params"]:
                p.grad = torch.zeros_like(p)
        with torch.no_grad():
            stepped.step()
        state = stepped.state_dict()
        left, groups = state["state"], state["param_groups"]
        return (
            len(known["param_groups"]) == len(groups)
            and all(map(_is_group_like, known["param_groups"], groups))
            and all(_is_like(entries, left.get(number)) for number, entries in known["state"].items())
            and set(known["state"]) in (set(), set(left))  # Nothing is left before the first step.
        )


def _unpacked(state: bytes) -> Any:
    """The object that `torch.save` wrote; None where the bytes are none, or hold more than tensors and numbers."""
    if not zipfile.is_zipfile(io.BytesIO(state)):
        return None
    try:
        return torch.load(io.BytesIO(state), weights_only=True)
    except Exception:  # Of which damaged bytes raise many kinds, some with the advice to load anything.
        return None


def _is_group_like(group: Any, like: dict[str, Any]) -> bool:
    """True if a group has the tensors and settings of another one; floating settings, such as rates, may differ."""
    if not isinstance(group, dict) or not group.keys() >= like.keys():
        return False
    floats = {key for key, value in like.items() if isinstance(value, (float, tuple, torch.Tensor))}
    return all(_is_like(group[key], x) if key in floats else group[key] == x for key, x in like.items())


def _is_like(x: Any, like: Any) -> bool:
    """True if a state has all entries of another one, of the same types, and tensors of the same shapes.

    Numbers are finite where those of the other one are, and counters are positive; where the other one has None, there
    may be anything.
    """
    if isinstance(like, torch.Tensor):
        alike = isinstance(x, torch.Tensor) and (x.shape, x.dtype) == (like.shape, like.dtype)
        finite = alike and bool((x.isfinite() | ~like.isfinite().to(x.device)).all())
        return finite and (x.dim() > 0 or bool(x >= 0))
    if isinstance(like, dict):
        return isinstance(x, dict) and all(key in x and _is_like(x[key], value) for key, value in like.items())
    if isinstance(like, (list, tuple)):
        return type(x) is type(like) and len(x) == len(like) and all(map(_is_like, x, like))
    if isinstance(like, float):
        return isinstance(x, float) and (math.isfinite(x) or not math.isfinite(like))
    return like is None or type(x) is type(like)

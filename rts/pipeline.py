"""numba's compiler without what loops do not need: functions that only they call have no machine code of their own.

A loop has what it calls linked into it, ours (`rts.compiling.compiled`) and numba's own (`min`, `np.empty`). numba
makes machine code of each of these all the same, with two wrappers where it is numba's. Here they stay intermediate
code, which is optimised in the loops. It saves a quarter of the time.

numba also counts references to every array that a function is handed, by calls that stay in code with branches. Where
a function of ours is certain to make no array and to return none, whoever calls it holds them all, and nothing is
counted: such code runs in half the time.

numba is told by classes of pipelines, and by a target of ours that inherits all from the processor. This depends on
parts of numba that it does not promise to keep, so nothing but `rts.compiling` imports it, which does without it where
that fails.
"""

from __future__ import annotations

import inspect
from typing import Any

import numba
from numba.core import ir, typed_passes, types
from numba.core.base import BaseContext
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, Flags
from numba.core.compiler_machinery import AnalysisPass, PassManager, register_pass
from numba.core.target_extension import CPU, dispatcher_registry, jit_registry

TESTED = (0, 60), (0, 68)
"""The first and the last of numba's versions with which this is known to work."""
_PARAMETERS = ["typingctx", "targetctx", "library", "args", "return_type", "flags", "locals"]
_NEEDED = {
    Compiler: ["define_pipelines"],
    JITCodeLibrary: [
        "codegen",
        "get_pointer_to_function",
        "_ensure_finalized",
        "_finalize_final_module",
        "_finalize_dynamic_globals",
        "_optimize_final_module",
    ],
    Flags: ["copy", "no_cpython_wrapper", "no_cfunc_wrapper", "release_gil", "inline"],
    BaseContext: ["subtarget", "enable_nrt"],
    PassManager: ["add_pass_after", "finalize"],
    typed_passes: ["IRLegalization"],
}
if not TESTED[0] <= numba.version_info.short <= TESTED[1]:
    raise ImportError(f"not tested with numba {numba.__version__}")
if [*inspect.signature(Compiler).parameters] != _PARAMETERS or not all(
    hasattr(owner, name) for owner, names in _NEEDED.items() for name in names
):
    raise ImportError("this numba is built in another way")


class _NoEnvironments:
    """A code generator for code that is nowhere yet, and has no place for what it refers to."""

    def __init__(self, generator: Any):
        self._generator = generator

    def set_env(self, name: str, environment: Any) -> None:
        """Leave it."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._generator, name)


class _Part(JITCodeLibrary):
    """Code to be linked into others, which has machine code only where it needs a place of its own.

    That is where it refers to Python's objects (to print them, or to raise errors with values), by what numba calls its
    environment, and where two call one another, which numba links by address.
    """

    _alone = False

    @property
    def codegen(self) -> Any:
        """The code generator, as whoever prepares a function to be called sees it."""
        self._ensure_finalized()
        return self._codegen if self._alone else _NoEnvironments(self._codegen)

    def get_pointer_to_function(self, name: str) -> int:
        """Null: there is none."""
        self._ensure_finalized()
        return super().get_pointer_to_function(name) if self._alone else 0

    def _optimize_final_module(self) -> None:
        """Leave that to what it is linked into, where that will do."""
        names = [x.name for x in self._final_module.global_variables]
        names = [x for x in names if x.startswith(("_ZN08NumbaEnv", ".numba.unresolved$"))]
        text = str(self._final_module) if names else ""
        # An environment that nothing refers to is named once, where it is declared.
        self._alone = any(x.startswith(".") or text.count("@" + x) > 1 for x in names)
        if self._alone:
            super()._optimize_final_module()

    def _finalize_final_module(self) -> None:
        if self._alone:
            super()._finalize_final_module()
            return
        self._finalize_dynamic_globals()
        self._finalized = True


class _Flags(Flags):
    """Flags whose copies, if they are equal, are one object.

    numba looks up its own functions by them, for every operator of every function, and compares all flags if they are
    not one object. What says how a caller is wrapped does not concern what it calls.
    """

    __slots__ = ()
    _copies: dict[Flags, Flags] = {}

    def copy(self) -> Flags:
        """What the functions that are called know of these flags."""
        flags: Any = Flags(self)
        flags.no_cpython_wrapper = flags.no_cfunc_wrapper = flags.release_gil = True
        flags.inline = "never"
        return self._copies.setdefault(flags, flags)


class _Loops(Compiler):
    """Compiles functions that Python calls."""

    def __init__(
        self, typingctx: Any, targetctx: Any, library: Any, args: Any, return_type: Any, flags: Any, locals: Any
    ):
        targetctx = targetctx.subtarget(target=_Target)
        super().__init__(typingctx, targetctx, library, args, return_type, _Flags(flags), locals)


class _Parts(_Loops):
    """Compiles functions that only compiled functions call."""

    def define_pipelines(self) -> list[Any]:
        """numba's, which put the code in the library that is there."""
        if self.state.library is None:
            self.state.library = _Part(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        return super().define_pipelines()


class _OwnParts(_Parts):
    """Compiles those that are ours."""

    def define_pipelines(self) -> list[Any]:
        """Those of all parts, in which references are not counted without need."""
        found = super().define_pipelines()
        for passes in found:
            passes.add_pass_after(_Uncounted, typed_passes.IRLegalization)
            passes.finalize()
        return found


_HARMLESS = ir.Assign, ir.Del, ir.Jump, ir.Branch, ir.Return, ir.StaticRaise
_VIEWS = {"getitem", "static_getitem", "getattr", "cast", "phi", "build_tuple", "exhaust_iter", "getiter", "iternext"}
_VIEWS |= {"pair_first", "pair_second"}
"""Statements that make nothing, and operations that refer to arrays which are there."""
_DESCRIBING = {"shape", "size", "ndim", "strides", "dtype", "T"}
"""Attributes of arrays that make none."""


@register_pass(mutates_CFG=False, analysis_only=True)
class _Uncounted(AnalysisPass):
    """Has references not counted in a function that is handed all the arrays it works on, and returns none.

    Where there is any doubt they are counted: where it knows other objects than numbers, arrays and tuples of these, or
    hands arrays to functions of numba's.
    """

    _name = "rts_uncounted"

    def __init__(self) -> None:
        super().__init__()

    def run_pass(self, state: Any) -> Any:
        """Change how the function is lowered, not the function."""
        kinds, models = state.typemap, state.targetctx.data_model_manager

        def counted(*variables: Any) -> bool:
            return any(models[kinds[x.name]].contains_nrt_meminfo() for x in variables if isinstance(x, ir.Var))

        def plain(kind: Any) -> bool:
            members: Any = kind
            if isinstance(kind, types.BaseTuple):
                return all(map(plain, members))
            known = isinstance(kind, types.Array) or not models[kind].contains_nrt_meminfo()
            return known and not isinstance(kind, types.Generator)

        def makes(target: ir.Var, value: Any) -> bool:
            if not isinstance(value, ir.Expr):
                return False
            if value.op == "call":
                called = kinds[value.func.name]
                if isinstance(called, types.Dispatcher) or getattr(called, "typing_key", None) is len:
                    return counted(target)
                return counted(target, value.func, *value.args, *(x for _, x in value.kws), value.vararg)
            if value.op == "getattr" and isinstance(kinds[value.value.name], types.Array):
                return value.attr not in _DESCRIBING
            if value.op in ("getitem", "static_getitem"):
                return counted(value.index if value.op == "getitem" else value.index_var)
            return value.op not in _VIEWS and counted(target, *value.list_vars())

        def harmless(statement: Any) -> bool:
            if isinstance(statement, ir.SetItem):  # An array may be copied first.
                return not counted(statement.value, statement.index)
            if isinstance(statement, ir.StaticSetItem):
                return not counted(statement.value, statement.index_var)
            if isinstance(statement, ir.Assign):
                return not makes(statement.target, statement.value)
            return isinstance(statement, _HARMLESS)

        body = (statement for block in state.func_ir.blocks.values() for statement in block.body)
        returns = models[state.return_type].contains_nrt_meminfo()
        made = state.func_ir.is_generator or returns or not all(map(plain, kinds.values()))
        if not made and all(map(harmless, body)):
            state.targetctx = state.targetctx.subtarget(enable_nrt=False)
        return False


LOOP = {"no_cfunc_wrapper": True, "pipeline_class": _Loops}
PART = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "pipeline_class": _OwnParts}


class _Target(CPU):
    """The processor, as loops have it."""


def _for_loops(*args: Any, **options: Any) -> Any:
    """Numba's decorator, as it is used for its own functions where loops call them."""
    return numba.jit(*args, **(options | PART | {"pipeline_class": _Parts}))


dispatcher_registry[_Target] = dispatcher_registry[CPU]
jit_registry[_Target] = _for_loops

"""Sources of scenes: built-in names, model files, Python files and functions."""

from __future__ import annotations

import contextlib
import importlib.util
import inspect
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rts import Camera, Engine, Part, engine_of, namespace
from rts.errors import InputError, RtsError
from rts.plugin_api.arrays import Tree, leaves, map_leaves
from rts.plugin_api.checks import is_count, quoted
from rts.tool_api.scenes import check_scene, default_camera
from rts_compare import builtin_scenes
from rts_compare.compared_settings import engines
from rts_compare.moving_scenes import Scene, check_directions, is_constant, moving, parts_of
from rts_compare.skip_reasons import one_line

SIZE = (256, 256)
FEW = 6
"""Arrays of at most so many numbers have a mode for each number."""
VARIADIC = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


def scene_of(
    scene: Any,
    parameters: Tree = None,
    directions: Mapping[str, Tree] | None = None,
    size: tuple[int, int] | None = None,
    *,
    surface: str = "mesh",
) -> Scene:
    """Make a `Scene` from any of the forms in which users name or give one.

    Args:
        scene: a `Scene`; the name of a built-in one; the path of a model; the path of a Python file, perhaps with
            ":name" of a function or `Scene` in it, "scene" by default; or a function: () or parameters →
            (parts, camera).
        parameters: of the function: an array, or nested dicts and lists of them. A Python file may have them under
            the name "parameters". None for a function without arguments, whose parts move in the
            modes of `moving`. A `Scene` has its own: `parameters` and `directions` are then ignored.
        directions: mode → direction of the parameters; None for one mode for each number of small arrays, and one
            random direction for each larger array.
        size: (height, width); None for the scene's own, 256² where it has none.
        surface: the name of the surface that reads a model, such as "mesh" or "bezier".

    Raises:
        InputError: there is no such scene, its code fails, or an argument or a direction does not suit. A function of
            parameters is not called here: `engines_for` checks its result.
    """
    if size is not None:
        if not (isinstance(size, (tuple, list)) and len(size) == 2 and all(map(is_count, size))):
            raise InputError(f"size is {quoted(size)}; expected (height, width), two positive integers")
        size = int(size[0]), int(size[1])
    if directions is not None and not isinstance(directions, Mapping):
        raise InputError(f"directions is {quoted(directions)}; expected parameters' changes by name, in a dict")
    if isinstance(scene, Scene):
        found = scene
    elif callable(scene):
        found = _of_function(scene, getattr(scene, "__name__", type(scene).__name__), parameters, directions)
    elif isinstance(scene, (str, Path)):
        found = _named(str(scene), parameters, directions, surface, size or SIZE)
    else:
        raise InputError(f"scene is {quoted(scene)}; expected a name, a model's path, or lambda: (parts, camera)")
    if size is not None:
        found = replace(found, size=size)
    if not found.directions:
        raise InputError(f"nothing moves in {found.name!r}; expected a scene with parameters")
    check_directions(found)
    return found


def some_modes(scene: Scene, modes: Sequence[str] | None) -> Scene:
    """The scene with the modes of these names; None for all.

    Raises:
        InputError: the scene lacks one of them, or `modes` is empty or no list of names.
    """
    if modes is None:
        return scene
    known = isinstance(modes, (list, tuple)) and all(isinstance(mode, str) for mode in modes)
    if not known or not modes or any(mode not in scene.directions for mode in modes):
        raise InputError(f"modes is {quoted(modes)}; expected some of {', '.join(scene.directions)}")
    return scene.with_modes(modes)


def _named(
    name: str, parameters: Tree, directions: Mapping[str, Tree] | None, surface: str, size: tuple[int, int]
) -> Scene:
    match = re.fullmatch(r"(.*\.py)(?::(\w*))?", name, re.DOTALL)
    path, function = Path(match[1] if match else name), match[2] if match else None
    if path.suffix == ".py":
        module = _module(path)
        found = getattr(module, function or "scene", None)
        if not (callable(found) or isinstance(found, Scene)):
            raise InputError(f"{path} has no function {function or 'scene'!r}; name one: {path}:NAME")
        if isinstance(found, Scene):
            return found
        given = getattr(module, "parameters", None) if parameters is None else parameters
        return _of_function(found, function or path.stem, given, directions)
    if parameters is not None or directions is not None:
        raise InputError("parameters or directions were given; only functions of parameters have them")
    if path.suffix and os.path.exists(path):
        return of_model(path, surface, size)
    if path.suffix:
        raise InputError(
            f"{path} does not exist; expected a model, a Python file, or one of {', '.join(builtin_scenes.names())}"
        )
    return builtin_scenes.builtin(name)


def of_model(path: Path, surface: str, size: tuple[int, int]) -> Scene:
    """The scene of a model, seen as `rts render` sees it, whose parts all move."""
    from rts import load

    parts = load(path, surface=surface)
    return moving(path.stem, parts, default_camera(parts, size), size, note=f"the model {path.name}")


def _module(path: Path) -> Any:
    """The module of a Python file, run with its folder on the import path."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise InputError(f"{path} does not exist; expected a Python file")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look up their module there.
    sys.modules.setdefault(path.stem, module)
    sys.path.insert(0, str(path.parent.resolve()))
    try:
        with _told(str(path)):
            spec.loader.exec_module(module)
    finally:
        sys.path.pop(0)
    return module


@contextlib.contextmanager
def _told(what: str) -> Iterator[None]:
    """Turn errors in the block, a user's code, into an InputError of one line; errors of the library pass as is."""
    try:
        yield
    except (Exception, SystemExit) as error:
        if isinstance(error, RtsError):
            raise
        raise InputError(f"{what} fails: {type(error).__name__}: {one_line(str(error))}") from error


def _of_function(f: Callable, name: str, parameters: Tree, directions: Mapping[str, Tree] | None) -> Scene:
    if parameters is None:
        needed = [
            p for p in inspect.signature(f).parameters.values() if p.default is p.empty and p.kind not in VARIADIC
        ]
        if needed:
            raise InputError(
                f"{name} takes parameters; pass parameters=, or let its Python file have them by that name"
            )
        with _told(name):
            found = f()
        if isinstance(found, Scene):
            return found
        parts, camera = checked(found, name)
        if not is_constant([p.theta for p in parts]):
            raise InputError(f"{name} gave arrays of an engine; expected NumPy where there are no parameters")
        return moving(name, parts, camera, SIZE)
    parameters = map_leaves(_float_array, parameters)
    if not any(np.size(x) for x in leaves(parameters)):
        raise InputError("parameters holds no numbers; expected arrays, in nested dicts and lists")
    return Scene(name, f, parameters, _modes(parameters) if directions is None else directions, SIZE)


def _float_array(x: Any) -> Any:
    """A leaf of parameters: NumPy's and Python's real numbers as float32, floating arrays of engines detached.

    Raises:
        InputError: the leaf is something else.
    """
    if is_constant(x) and np.asarray(x).dtype.kind in "biuf":
        return np.asarray(x, np.float32)
    dtype = getattr(x, "dtype", None)
    if dtype is None or is_constant(x) or not namespace(x).isdtype(dtype, "real floating"):
        raise InputError(f"parameters holds {quoted(x)}; expected arrays of real numbers, in nested dicts and lists")
    return engine_of(x).stop_gradient(x)


def engines_for(scene: Scene, chosen: Sequence[str] | None = None) -> tuple[list[Engine], list[str]]:
    """The engines that can compute a scene, first the one that measures errors; and lines on engines that cannot.

    Args:
        scene: the scene.
        chosen: names; None for the engine whose arrays the parameters are or, for NumPy's, all that are installed.

    Raises:
        InputError: no engine can compute the scene, or as for `engines`.
        PluginError: as for `engines`.
    """
    own = engine_of(scene.parameters)
    found, left_out = engines([own.name] if own.differentiates and chosen is None else chosen)
    can, first = [], next(iter(scene.directions))
    for engine in found:
        try:
            with _told(scene.name):
                checked(scene.at(scene.moved(first, 0.0, engine)), scene.name)
            can.append(engine)
        except RtsError as error:
            left_out.append(f"engine {engine.name!r}: {error}")
            if engine is found[-1] and not can:
                raise
    return can, left_out


def checked(found: Any, name: str) -> tuple[list[Part], Camera]:
    """The parts and the camera that a function gave.

    Raises:
        InputError: it gave something else, parts that cannot be drawn, or colours of other than three channels.
    """
    if not (isinstance(found, tuple) and len(found) == 2 and isinstance(found[1], Camera)):
        raise InputError(f"{name} gave {quoted(found)}; expected (parts, camera)")
    parts, camera = found
    channels = check_scene(parts, camera)[0][0].shader.channels
    if channels != 3:
        raise InputError(
            f"the shaders of {name} give {channels} channels besides alpha; expected 3, since errors are of colours"
        )
    return parts_of(found), camera


def _modes(parameters: Tree) -> dict[str, Tree]:
    """Mode → direction: one for each number of arrays of at most `FEW`, a random one for each larger array."""
    names, shapes = [*_names(parameters)], [tuple(np.shape(x)) for x in leaves(parameters)]
    found = {}
    for index, (name, shape) in enumerate(zip(names, shapes, strict=True)):
        count = int(np.prod(shape))
        choices = np.eye(count) if count <= FEW else np.random.default_rng(0).normal(size=(1, count))
        for number, values in enumerate(choices):
            label = f"{name}[{number}]" if 1 < count <= FEW else name
            found[label] = _only(parameters, index, values.reshape(shape))
    return found


def _names(tree: Tree, place: str = "") -> Iterator[str]:
    """The names of leaves, such as "light.direction", in the order of `leaves`; a single array is "parameters"."""
    if isinstance(tree, Mapping):
        items = [(key, tree[key]) for key in sorted(tree)]
    elif isinstance(tree, (list, tuple)):
        items = list(enumerate(tree))
    else:
        yield place or "parameters"
        return
    for key, value in items:
        yield from _names(value, f"{place}.{key}" if place else str(key))


def _only(parameters: Tree, index: int, values: np.ndarray) -> Tree:
    """A direction with `values` in the leaf `index` of the parameters, and zeros in all other leaves."""
    number = iter(range(sum(1 for _ in leaves(parameters))))
    return map_leaves(lambda x: values if next(number) == index else np.zeros(np.shape(x)), parameters)

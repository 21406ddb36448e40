"""Ways of rendering a mixed scene that have to give one image and one gradient, and how far they are apart.

`python tests/mixed_ways.py 0:500` renders the scenes of these numbers in all ways, and counts the differences by kind.
"""

import argparse
import collections
import contextlib
import functools
import itertools
import time
import warnings

import numpy as np
import pytest
from found_outlines import sampled_with_outlines
from helpers import arrays, derivative, gradient, precision, to_numpy
from mixed_scenes import mixed_of

import rts
from rts.arrays.engines import context_of
from rts.arrays.trees import leaves, map_leaves
from rts.compiling import threads
from rts.rendering.settings import RenderSettings
from rts.splatting import layers, stencil

SAMPLERS = ("embree", "reference")
"""Names of samplers, in place of "raster"."""

FLAGS = (
    *("threads", "views", "prepared", "enough", "bands", "shuffled", "found", *SAMPLERS),
    *("specified", "forward", "numpy", "jax", "jit"),
)
"""How a way differs from `rts.render` of torch arrays, and a gradient in reverse mode.

- threads: on four threads, however little work there is.
- views: `rts.render_views` of both cameras, in place of one call each.
- prepared: by `rts.prepare`.
- enough: with the least capacity that drops nothing.
- bands: in bands of two rows.
- shuffled: the parts in the reverse order.
- found: with `layers="auto"`, compared with `LAYERS`, which is enough.
- embree, reference: by this sampler.
- specified: by the splatter in array code.
- forward: a derivative in forward mode.
- numpy, jax, jit: arrays of NumPy, of jax, and of jax in a compiled program.
"""

NEVER = ({"numpy", "jax"}, {"numpy", "jit"}, {"jax", "jit"}, {"numpy", "forward"}, {"prepared", "shuffled"})
TOO_LONG = ({"specified", "jax"}, {"specified", "jit"}, {"bands", "jax"}, {"bands", "jit"})
"""Pairs that make no sense, and those that XLA compiles for minutes."""
ALONE = {*SAMPLERS, "found"}
"""Ways that are tried without others."""

SINGLES = [frozenset([flag]) for flag in FLAGS]
PAIRS = [
    frozenset(pair)
    for pair in itertools.combinations([flag for flag in FLAGS if flag not in ALONE], 2)
    if set(pair) not in NEVER + TOO_LONG
]
LAYERS = 16
"""More layers than the scenes have."""

MOST = 1e-5
"""The largest difference of images, and of derivatives as a share of the largest, in float64."""

IGNORED = rts.errors.EmptyImageWarning, rts.errors.LayersWarning, rts.errors.InputWarning


def name_of(way):
    """The way in words."""
    return " ".join(sorted(way, key=FLAGS.index)) or "plain"


def differences(number, way):
    """How a way differs from the plain one: pairs (what, how far), without those of at most `MOST`.

    The share is that of a gradient's largest entry. In forward mode, along one direction, it is that of its length.
    """
    scene = mixed_of(number)
    (image, slopes), (expected, known) = result_of(scene, way), _plain(number, "views" in way, _layers(scene, way))
    off = {"image": np.abs(image - expected).max()}
    if "forward" in way:
        push = known @ _flat(_along(scene))
        off["derivative"] = np.abs(slopes - push) / max(np.linalg.norm(known), MOST)
    elif slopes is not None:
        off["gradient"] = np.abs(slopes - known).max() / max(np.abs(known).max(), MOST)
    return [(what, float(x)) for what, x in off.items() if not x <= MOST]


@functools.lru_cache(4)
def _plain(number, both, layers):
    """The result of the plain way, of one view or both."""
    scene = mixed_of(number)._replace(layers=layers)
    if not both:
        return result_of(scene, frozenset())
    (first, slope), (second, other) = (
        result_of(scene._replace(cameras=[camera]), frozenset(), i) for i, camera in enumerate(scene.cameras)
    )
    return np.concatenate([first, second]), slope + other


def _layers(scene, way):
    """The number of layers, which has to be known in compiled programs."""
    if "found" in way:
        return LAYERS
    return 6 if "jit" in way and scene.layers == "auto" else scene.layers


def result_of(scene, way, view=0):
    """The images (B, H, W, 4) of a scene, and their derivative: a flat gradient, or a number in forward mode.

    Args:
        scene: a `Mixed`.
        way: its flags.
        view: the index of the first view, whose weights count.
    """
    cameras = scene.cameras if "views" in way else scene.cameras[:1]
    engine = "numpy" if "numpy" in way else "jax" if {"jax", "jit"} & way else "torch-cpu"
    compiled = __import__("jax").jit if "jit" in way else lambda f: f
    weights = np.random.default_rng(0).normal(size=(2, *scene.size, 4))[view : view + len(cameras)]
    layers = "auto" if "found" in way else _layers(scene, way)
    options = {"layers": layers, "supersample": scene.supersample}
    options["sampler"] = next((name for name in SAMPLERS if name in way), "auto")
    with precision(engine), _patched(way), warnings.catch_warnings():
        for kind in IGNORED:
            warnings.simplefilter("ignore", kind)
        if "enough" in way:
            options["capacity"] = least_capacity(scene, cameras, options)
        if "jit" in way:
            options["capacity"] = room_for_crossings(scene, cameras, options)
        weights, still = arrays(engine, (weights, _values(scene)), np.float64)
        prepared = rts.prepare(scene.parts if scene.poses else _parts(scene, still)) if "prepared" in way else None

        def images(values):
            parts = _parts(scene, values, prepared)
            return _images(parts[::-1] if "shuffled" in way else parts, cameras, scene.size, way, options)

        if engine == "numpy":
            return images(still), None
        if "forward" in way:
            image, push = derivative(
                engine, compiled(images), still, arrays(engine, _along(scene), np.float64), jit=False
            )
            return image, (push * to_numpy(weights)).sum()
        slopes = gradient(engine, compiled(lambda values: (images(values) * weights).sum()), still, jit=False)
        return to_numpy(compiled(images)(still)), _flat(slopes)


def least_capacity(scene, cameras, options):
    """The least capacity with which no sample is dropped in any view."""
    parts = _parts(scene, _values(scene))

    def drops(capacity):
        sampled = (rts.sample(parts, camera, scene.size, capacity=capacity, **options) for camera in cameras)
        return any(int(s.overflow) for s in sampled)

    low, high = 0, 1
    while drops(high):
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if drops(middle) else (low, middle)
    return high


def room_for_crossings(scene, cameras, options):
    """A capacity with which programs have room for the breaks of all views; None if they have it anyway."""
    parts = _parts(scene, _values(scene))
    found = [sampled_with_outlines(parts, camera, scene.size, **options) for camera in cameras]
    most, row = max(len(outlines.gap) for _, outlines in found), found[0][0].row
    given = options.get("capacity")
    if most <= 8 * sum(row.shape[1:]):
        return given
    return max(4 * most, given or row.size)


def _values(scene):
    """The arrays that move: a pose of each part, or the vertices and colours of each."""
    return [{"pose": np.zeros(6)} if scene.poses else dict(part.theta) for part in scene.parts]


def _along(scene):
    """A direction of `_values`."""
    rng = np.random.default_rng(1)
    return map_leaves(lambda x: rng.normal(size=x.shape), _values(scene))


def _parts(scene, values, prepared=None):
    """The parts at some values; with the structures of `prepared` parts, if there are any."""
    changes = [{"transform": rts.rigid(v["pose"])} if scene.poses else {"theta": v} for v in values]
    if prepared is None:
        return [part.replace(**change) for part, change in zip(scene.parts, changes, strict=True)]
    for i, change in enumerate(changes):
        prepared = prepared.replace(i, **change)
    return prepared


def _images(parts, cameras, size, way, options):
    if "views" in way:
        return rts.render_views(parts, cameras, size, **options)
    images = [rts.render(parts, camera, size, **options) for camera in cameras]
    return rts.namespace(images[0]).stack(images)


@contextlib.contextmanager
def _patched(way):
    """The library as a way wants it: with several threads for the least work, with array code in place of loops."""
    with pytest.MonkeyPatch.context() as patch:
        if "threads" in way:
            patch.setenv("RTS_NUM_THREADS", "4")
            patch.setattr(threads, "LITTLE_WORK", 1)
        if "bands" in way:
            patch.setattr(RenderSettings, "bands", _thin_bands)
        if "specified" in way:
            patch.setattr(stencil, "SPLAT", _specified_splat)
            patch.setattr(layers, "LAYERS", layers._specification)
        yield


def _specified_splat(*arrays, **options):
    """The specification of `stencil.SPLAT`, which takes what is NumPy beside arrays of an engine, as that does."""
    return stencil._specification(*context_of(list(arrays)).constants(list(arrays)), **options)


def _thin_bands(_, size):
    """The result of `RenderSettings.bands`, of two rows each; the last may have three."""
    tops = [*range(0, max(size[0] - 1, 1), 2), size[0]]
    return [(top, end - top) for top, end in itertools.pairwise(tops)]


def _flat(tree):
    return np.concatenate([np.ravel(x) for x in leaves(tree)])


def ways_of(number, every):
    """The ways that the scene of a number is tried in.

    All single ones and three pairs, so that each pair has its turn; those of jax, which compile for seconds, at every
    `every`-th number.
    """
    ways = [*SINGLES, *(PAIRS[(3 * number + i) % len(PAIRS)] for i in range(3))]
    return [way for way in ways if not way & {"jax", "jit"} or number % every == 0]


def _differences_or_error(number, way):
    """The differences; an error that is raised is one, too, so that a long run goes on."""
    try:
        return differences(number, way)
    except Exception as error:
        return [(f"{type(error).__name__}: {str(error).splitlines()[0]}", np.inf)]


def main():
    """Count the differences of the scenes of a range of numbers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("numbers", help="such as 0:500")
    parser.add_argument("--jax", type=int, default=5, help="jax at every so many numbers")
    parser.add_argument("--ways", help="names of single ways alone, such as bands,shuffled")
    parser.add_argument("--seconds", type=float, default=np.inf, help="stop after so many")
    given = parser.parse_args()
    first, last = map(int, given.numbers.split(":"))
    ways = given.ways and [frozenset([name]) for name in given.ways.split(",")]
    began, number = time.monotonic(), first
    tried, found, worst = collections.Counter(), collections.defaultdict(set), collections.defaultdict(float)
    for number in range(first, last):
        scene = mixed_of(number)
        kind = "translucent" if scene.translucent else "opaque"
        for way in ways_of(number, given.jax) if ways is None else ways:
            tried[kind, name_of(way)] += 1
            for what, off in _differences_or_error(number, way):
                key = kind, name_of(way), what
                found[key].add(number)
                worst[key] = max(worst[key], off)
                print(f"{number} {kind}, {name_of(way)}: {what} off by {off:.2g}", flush=True)
        if time.monotonic() - began > given.seconds:
            break
    print(f"\n{number + 1 - first} scenes; scenes that differ, of so many tried")
    for key in sorted(found):
        print(
            f"{' | '.join(key)}: {len(found[key])} of {tried[key[:2]]}, by up to {worst[key]:.2g}; {sorted(found[key])}"
        )


if __name__ == "__main__":
    main()

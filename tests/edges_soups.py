"""Soups and ties drawn by found edges, with either sampler and by loops or array code, and how far they are apart.

`python tests/edges_soups.py 0:1500` draws the soups and the ties of these numbers, and counts those that differ.
"""

import argparse
import contextlib
import time
import warnings

import numpy as np
import pytest
import torch
from soups import soup_of
from ties import ties_of

import rts
from rts.splatting import edges

LIMIT = 1e-6
"""The largest difference of images, and of gradients as a share of the largest, in float64."""


def soup(number):
    """Meshes, camera, size and culling of a soup."""
    found = soup_of(number)
    return [(found.vertices, found.faces)], found.camera, found.size, found.cull


def ties(number):
    """Meshes, camera, size and culling of ties."""
    found = ties_of(number)
    return found.meshes, found.camera, found.size, found.cull


KINDS = {"soup": soup, "ties": ties}


@contextlib.contextmanager
def as_specified(wanted):
    """Found edges by array code, if it is wanted."""
    with pytest.MonkeyPatch.context() as patch:
        if wanted:
            patch.setattr(edges, "EDGES", edges._specification)
        yield


def drawn(kind, number, sampler="raster", specified=False):
    """The image, the gradient of all vertices, flat, and where breaks are: rows of gap and place."""
    (meshes, camera, size, cull), rng = KINDS[kind](number), np.random.default_rng(number)
    vertices = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v, _ in meshes]
    thetas = [{"vertices": v, "colors": rng.random((len(v), 3))} for v in vertices]
    pairs = zip(meshes, thetas, strict=True)
    parts = [rts.Part(rts.Mesh(faces), theta, "unlit", cull=cull) for (_, faces), theta in pairs]
    along = torch.tensor(rng.normal(size=(*size, 4)))
    with warnings.catch_warnings(), as_specified(specified):
        warnings.simplefilter("ignore", rts.errors.EmptyImageWarning)
        warnings.simplefilter("ignore", rts.errors.InputWarning)  # Some soups are closed, and wound inside out.
        sampled = rts.sample(parts, camera, size, sampler=sampler, splatter="edges")
        image = rts.render_samples(sampled, parts, camera, splatter="edges")
        slopes = torch.autograd.grad((image * along).sum(), vertices, materialize_grads=True)
    outlines = sampled.outlines
    breaks = np.column_stack([np.asarray(outlines.gap), np.asarray(outlines.place)])
    return image.detach().numpy(), np.concatenate([g.numpy().ravel() for g in slopes]), breaks


def differences(kind, number):
    """Words for how drawings of a scene differ."""
    image, slopes, breaks = drawn(kind, number)
    said = [] if np.isfinite(image).all() and np.isfinite(slopes).all() else ["not finite"]
    for name, options in (("reference", {"sampler": "reference"}), ("specification", {"specified": True})):
        other, other_slopes, other_breaks = drawn(kind, number, **options)
        if len(breaks) != len(other_breaks):
            said.append(f"{name}: {len(breaks)} breaks, not {len(other_breaks)}")
        elif len(breaks) and np.abs(breaks - other_breaks).max() > LIMIT:
            said.append(f"{name}: breaks off by {np.abs(breaks - other_breaks).max():.2g}")
        if not np.abs(image - other).max() <= LIMIT:
            said.append(f"{name}: image off by {np.abs(image - other).max():.2g}")
        largest = np.abs(slopes).max(initial=0)
        if not np.abs(slopes - other_slopes).max(initial=0) <= LIMIT * largest:
            said.append(f"{name}: gradient off by {np.abs(slopes - other_slopes).max():.2g} of {largest:.2g}")
    return said


def main():
    """Count the scenes of a range of numbers that differ."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("numbers", help="such as 0:500")
    parser.add_argument("--seconds", type=float, default=np.inf, help="stop after so many")
    given = parser.parse_args()
    began, tried, wrong = time.monotonic(), dict.fromkeys(KINDS, 0), dict.fromkeys(KINDS, 0)
    for number in range(*map(int, given.numbers.split(":"))):
        for kind in KINDS:
            said = differences(kind, number)
            tried[kind] += 1
            wrong[kind] += bool(said)
            if said:
                print(f"{kind} {number}: {'; '.join(said)}", flush=True)
        if time.monotonic() - began > given.seconds:
            break
    print(*(f"{kind}: {wrong[kind]} of {tried[kind]} differ" for kind in KINDS), sep="\n")


if __name__ == "__main__":
    main()

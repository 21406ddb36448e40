"""Radiance fields, the weights of two networks each, read from files and written to files, never unpickled."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rts import Camera, InputError, engine_of
from rts.plugin_api.arrays import Tree, map_leaves
from rts.plugin_api.checks import quoted
from rts_surfaces.radiance_field.lattice import lattice
from rts_surfaces.radiance_field.ndc import Ndc
from rts_surfaces.radiance_field.network import REPEATED, Architecture, check_network, placed
from rts_surfaces.radiance_field.volume import VolumeImage, volume_image

NETWORKS = ("coarse", "fine")
LARGEST = 2**30
"""The most bytes of weights; a larger file holds no network of this kind."""


@dataclass(frozen=True, eq=False)
class RadianceField:
    """A coarse network, by which samples along rays are placed, and a fine one, which is the field.

    Attributes:
        weights: {"coarse": network, "fine": network}, nested dicts and lists of arrays of any engine (float32 NumPy as
            loaded): see `rts_surfaces.radiance_field.network.check_network`. θ["weights"] of a part is one of the two.

    Raises:
        InputError: a network is missing, or its weights do not fit together.
    """

    weights: Any

    def __post_init__(self):
        if not isinstance(self.weights, dict) or set(self.weights) != set(NETWORKS):
            raise InputError(f"weights are {quoted(self.weights)}; expected a dict of 'coarse' and 'fine'")
        for name in NETWORKS:
            check_network(self.weights[name], f"the network {name!r}")

    def __repr__(self) -> str:
        return f"RadianceField({', '.join(f'{name}: {self.architecture(name)}' for name in NETWORKS)})"

    def architecture(self, network: str = "fine") -> Architecture:
        """The architecture of the network "coarse" or "fine"."""
        return check_network(self.weights[network])

    def save(self, path: Any) -> None:
        """Write the weights as an .npz that `rts.load_radiance_field` reads, in their dtypes.

        Raises:
            InputError: another extension, or a path that cannot be or may not be written to.
        """
        path = Path(path)
        if path.suffix.lower() != ".npz":
            raise InputError(f"the radiance field is to be called {path.name!r}; expected a name ending in .npz")
        named = {".".join(map(str, place)): x for place, x in placed(self.on_host())}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez(path, **named)
        except OSError as error:
            raise InputError(f"{path} cannot be written ({error.strerror}); choose another name or folder") from error

    def lattice(
        self,
        bounds: Any,
        shape: tuple[int, int, int],
        *,
        network: str = "fine",
        keep: Any = True,
        progress: bool | None = None,
    ) -> np.ndarray:
        """Densities on a lattice, (X, Y, Z) float32; see `rts_surfaces.radiance_field.lattice`.

        Args:
            bounds: ((x0, y0, z0), (x1, y1, z1)) in the field's space, the first and the last point of the lattice.
            shape: (X, Y, Z), at least 2 each.
            network: "fine" or "coarse".
            keep: True to keep densities in the user's cache and to look for them there; a folder in place of the cache;
                False for neither.
            progress: True to show a progress bar; None to do so in a terminal.

        Raises:
            InputError: there is no such lattice or network.
        """
        return lattice(self, bounds, shape, network=network, keep=keep, progress=progress)

    def volume_render(
        self,
        camera: Camera,
        size: tuple[int, int],
        *,
        near: float | None = None,
        far: float | None = None,
        samples: tuple[int, int] = (64, 64),
        background: Literal["white", "black"] | Sequence[float] | np.ndarray | None = "white",
        ndc: Ndc | None = None,
        progress: bool | None = None,
    ) -> VolumeImage:
        """The image of the field by quadrature along rays, without noise and derivatives, as in NeRF's test mode.

        The coarse network is evaluated at N_c equal steps of depth (of disparity with `ndc`). Its samples' weights are
        a distribution along the ray, by whose inverse N_f more samples are placed. The fine network is evaluated at all
        N_c + N_f samples (Mildenhall et al. 2020, §4 and 5). Surface light fields are compared with this image.
        Computed by torch if installed, else by NumPy.

        Args:
            camera: a perspective camera; rays pass through the centres of its pixels (for rays as NeRF's, take cameras
                of `load_views` with `pixel_center`).
            size: (height, width) in pixels.
            near: depth at which rays begin; default 2, as in NeRF's Blender data sets; with `ndc`, always its near
                plane.
            far: depth at which rays end; default 6; with `ndc`, always infinity.
            samples: (N_c, N_f), at least 3 and 1.
            background: the colour behind the field: "white", "black" or (3,) from 0 to 1; None for transparency.
            ndc: the map from the world to the field's space; None if the field's space is the world.
            progress: True to show a progress bar, None to do so in a terminal, False for none.

        Returns:
            A named tuple: `image` (H, W, 3) float32 on the background, or (H, W, 4) premultiplied RGBA, in the encoding
            of the images that the field was trained on; `coarse` and `fine`, the evaluations of each network.

        Raises:
            InputError: an argument is wrong, or the camera is orthographic.
        """
        return volume_image(
            self,
            camera,
            size,
            near=near,
            far=far,
            samples=samples,
            background=background,
            ndc=ndc,
            progress=progress,
        )

    def on_host(self) -> Tree:
        """The weights of both networks, nested as `weights` is, as NumPy arrays without derivatives."""
        return map_leaves(engine_of(self.weights).to_numpy, self.weights)


def load_radiance_field(path: str | os.PathLike[str]) -> RadianceField:
    """The radiance field (Mildenhall et al. 2020) whose weights an .npz holds.

    Its arrays are called as krrish94/nerf-pytorch calls its layers, after the name of the network: coarse.layer1.weight
    (out, in), coarse.layer1.bias (out,), coarse.layers_xyz.0.weight, …, coarse.fc_alpha.weight, coarse.fc_feat.weight,
    coarse.layers_dir.0.weight, coarse.fc_rgb.weight, and so on for fine. Nothing is unpickled.

    To draw the field as a surface light field, take a part with the shader "radiance" and one of its networks as
    θ["weights"]. Its surface may be the isosurface of the density, `lattice`, at the value 50.

    Returns:
        An object with `weights`, {"coarse": network, "fine": network} of float32 NumPy arrays; `architecture(network)`;
        `lattice(bounds, shape)`, its density at points; `volume_render(camera, size)`; and `save(path)`.

    Raises:
        InputError: there is no such file, it is no .npz, holds pickles, or other than finite floating-point numbers; a
            layer is missing, unknown, or its shape does not fit.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise InputError(f"the path is a {type(path).__name__}; expected a string or pathlib.Path")
    path = Path(os.fsdecode(path))
    try:
        there = path.is_file()
    except OSError as error:
        raise InputError(f"the path {quoted(str(path))} is no good ({error.strerror}); choose another name") from None
    if not there:
        raise InputError(f"there is no file {path} of weights; check the path (relative paths start at {Path.cwd()})")
    networks: dict[str, Any] = {}
    for key, array in _arrays(path).items():
        network, _, rest = key.partition(".")
        *place, kind = rest.split(".")
        layer, number = (place + [None, None])[:2]
        known = network in NETWORKS and kind in ("weight", "bias") and bool(layer)
        if not known or len(place) != 1 + (layer in REPEATED) or not str(number or 0).isdecimal():
            raise InputError(
                f"{path} has an array {key[:60]!r}, of no layer that is known; expected such as 'fine.layer1.weight'"
            )
        layers = networks.setdefault(network, {})
        if number is None:
            layers.setdefault(layer, {})[kind] = array
        else:
            layers.setdefault(layer, {}).setdefault(int(number), {})[kind] = array
    for network in NETWORKS:
        if network not in networks:
            raise InputError(f"{path} lacks the layer '{network}.layer1'; expected the networks coarse and fine")
        for name in REPEATED:
            numbered = networks[network].get(name, {})
            gap = next((i for i in range(len(numbered)) if i not in numbered), None)
            if gap is not None:
                raise InputError(f"{path} lacks the layer '{network}.{name}.{gap}', though it has later ones")
            if numbered:
                networks[network][name] = [numbered[i] for i in range(len(numbered))]
        check_network(networks[network], f"{path}: the network {network!r}")
    return RadianceField(networks)


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an .npz by name, as float32.

    Raises:
        InputError: the file is damaged, holds pickles or more than `LARGEST` bytes, or an array is of other than
            floating-point numbers, finite in float32.
    """
    arrays = {}
    try:
        # NumPy leaves files open that are damaged, if it opens them.
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            total = sum(item.file_size for item in file.zip.infolist())
            if total > LARGEST:
                raise ValueError(f"it holds {total / 2**30:.1f} GB")
            for key in file.files:
                arrays[key] = np.asarray(file[key])
    except Exception as error:  # NumPy and zipfile raise many kinds.
        what = " ".join(str(error).split())[:80]
        raise InputError(f"{path} is no .npz of weights ({what}); expected numpy.savez's, without pickles") from error
    for key, array in arrays.items():
        if array.dtype.kind != "f":
            raise InputError(f"{path} has {key[:60]!r} of dtype {array.dtype}; expected floating numbers")
        with np.errstate(over="ignore"):
            arrays[key] = array.astype(np.float32)
        if not np.isfinite(arrays[key]).all():
            raise InputError(f"{path} has NaN, infinity or too large numbers in {key[:60]!r}; repair the file")
    return arrays

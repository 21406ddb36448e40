"""Radiance fields, as users reach them: what loads and draws them is found by name, as every plugin is."""

from __future__ import annotations

from typing import Any

from rts import registry
from rts.arrays.argument_checks import check_pixels, check_planes, quoted
from rts.errors import InputError
from rts.files.paths import as_path
from rts.files.posed_images import colour_named
from rts.ndc import Ndc
from rts.scene.camera import Camera


def load_radiance_field(path: Any) -> Any:
    """The radiance field (Mildenhall et al. 2020) whose weights an .npz holds.

    Its arrays are called as krrish94/nerf-pytorch calls its layers, after the name of the network: coarse.layer1.weight
    (out, in), coarse.layer1.bias (out,), coarse.layers_xyz.0.weight, …, coarse.fc_alpha.weight, coarse.fc_feat.weight,
    coarse.layers_dir.0.weight, coarse.fc_rgb.weight, and so on for fine. Nothing is unpickled.

    As a surface light field, it is a part with the shader "radiance" and one network of it as θ["weights"], on a
    surface such as where `lattice`, the density, is 50.

    Returns:
        An object with `weights`, {"coarse": network, "fine": network} of float32 NumPy arrays; `architecture(network)`;
        `lattice(bounds, shape)`, its density at points; and `save(path)`.

    Raises:
        InputError: there is no such file, it is no .npz, holds pickles, or something other than real finite numbers; a
            layer is missing, unknown, or its shape does not fit.
    """
    return registry.plugin("rts.shaders", "radiance").load(as_path(path))


def volume_render(
    field: Any,
    camera: Camera,
    size: tuple[int, int],
    *,
    near: float | None = None,
    far: float | None = None,
    samples: tuple[int, int] = (64, 64),
    background: Any = "white",
    ndc: Ndc | None = None,
    progress: bool | None = None,
) -> Any:
    """The image of a radiance field by quadrature along rays, as NeRF's test mode: without noise; no derivatives.

    The coarse network is evaluated at N_c equal steps of depth; N_f more samples are placed where it has weight, by
    the inverse of their distribution; the fine network is evaluated at all of them (Mildenhall et al. 2020, §4 and 5).
    It is what surface light fields are compared with. By torch where that is installed, else by NumPy.

    Args:
        field: what `load_radiance_field` gives; its weights may be arrays of any engine.
        camera: a perspective camera; rays pass through the centres of its pixels (for NeRF's own, cameras of
            `load_views` with `pixel_center`).
        size: (height, width).
        near: depth at which rays begin; default 2, as in NeRF's Blender scenes; with `ndc`, always its near plane.
        far: depth at which they end; default 6; with `ndc`, always infinity.
        samples: (N_c, N_f).
        background: what is behind: "white", "black" or a colour (3,); None for transparency.
        ndc: the map from the world to the field's space, or None where that is the world.
        progress: whether to show a progress bar; None to do so in a terminal.

    Returns:
        A named tuple: `image` (H, W, 3) float32 on the background, or (H, W, 4) premultiplied RGBA, in the encoding of
        the images that the field was trained on; `coarse` and `fine`, the evaluations of each network.

    Raises:
        InputError: an argument is none of these, or the camera is orthographic.
    """
    size = check_pixels(size)
    if ndc is None:
        near, far = 2.0 if near is None else near, 6.0 if far is None else far
        check_planes(near, far, positive=True)
    elif not isinstance(ndc, Ndc):
        raise InputError(f"ndc is {quoted(ndc)}; expected an Ndc, or None")
    elif near is not None or far is not None:
        raise InputError("near and far are given with ndc, whose rays run from its near plane to infinity; leave them")
    background = None if background is None else colour_named(background)
    planes = (0.0, 1.0) if ndc is not None else (near, far)
    options = {"planes": planes, "samples": samples, "background": background, "ndc": ndc, "progress": progress}
    return registry.plugin("rts.shaders", "radiance").volume_render(field, camera, size, **options)

"""Tangents: the direction in which u grows on a surface, by derivatives of the surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from rts.arrays.array_functions import dot
from rts.arrays.engines import Context, namespace
from rts.arrays.trees import Array, Tree
from rts.contracts.gbuffer import GBuffer
from rts.contracts.records import Samples
from rts.contracts.surface import Surface
from rts.operations.unit import unit
from rts.shading.textures import own_uv

TANGENT = "tangent"
"""Name of the attribute in the G-buffer."""
OWN_UV = own_uv("normal_map")


def tangents(
    surface: Surface,
    theta: Mapping[str, Tree],
    samples: Samples,
    gbuffer: Mapping[str, Array],
    context: Context,
) -> Array:
    """Unit tangents along u, and the sign of the bitangent (N, 4), local space; differentiable in positions and uv.

    The bitangent, along v, is sign · normal × tangent (MikkTSpace). A tangent is zero where uv does not change along
    the surface. The surface is evaluated once for each parameter, `Surface.param_step` away from the sample's: exact
    where position and uv are linear in the parameters, as on a mesh.

    Args:
        surface: a surface of two parameters a sample.
        theta: the entries that the surface reads, arrays of the engine.
        samples: the samples.
        gbuffer: "position" (N, 3), "normal" (N, 3) and "uv" (N, 2) of the samples, local space. Coordinates that normal
            maps have of their own, "uv_normal_map", take the place of "uv".
        context: the engine to compute with.

    Raises:
        InputError: samples have another number of parameters than two.
    """
    from rts.shading.parameter_steps import check_two_parameters, steps_beside

    check_two_parameters(surface, samples, TANGENT, "normal maps")
    name = OWN_UV if OWN_UV in gbuffer else "uv"
    params, position, uv = context.constants((samples.params, gbuffer["position"], gbuffer[name]))
    beside = steps_beside(surface, theta, replace(samples, params=params), position, uv, name)
    return tangent_along(gbuffer["normal"], *beside)


def tangent_along(normal: Array, first: tuple[Array, Array], second: tuple[Array, Array]) -> Array:
    """The G-buffer's "tangent" of a surface whose derivatives are known, differentiable; see `rts.GBuffer`.

    Args:
        normal: (N, 3), outward, of any length.
        first: derivatives of position (N, 3) and uv (N, 2) along one parameter of the surface.
        second: likewise along another one.

    Returns:
        (N, 4): the unit direction in which u grows and v stays, and the sign of the bitangent. The direction is zero
        where uv does not change, and where the surface does not, as at a point that is a whole side of a patch.
    """
    xp, (a, da), (b, db) = namespace(normal), first, second
    (au, av), (bu, bv) = ((change[:, :1], change[:, 1:2]) for change in (da, db))
    mirrored = au * bv - av * bu < 0
    along_u, along_v = a * bv - b * av, b * au - a * bu
    along_u = xp.where(mirrored, -along_u, along_u)
    turns_left = dot(xp.linalg.cross(normal, along_u), xp.where(mirrored, -along_v, along_v)) >= 0
    one = xp.ones_like(normal[:, :1])
    return xp.concat([unit(along_u), xp.where(turns_left, one, -one)], axis=1)


def tangent_frame(gbuffer: GBuffer) -> tuple[Array, Array, Array]:
    """Unit tangents along u, bitangents along v, and normals (N, 3) each, at right angles, where maps have directions.

    A direction (x, y, z) of a normal map is x · tangent + y · bitangent + z · normal.

    Args:
        gbuffer: "normal" (N, 3) and "tangent" (N, 4), as shaders receive them; not turned to the viewer.
    """
    normal, frame = gbuffer.unit("normal"), gbuffer[TANGENT]
    tangent = unit(frame[:, :3] - dot(normal, frame[:, :3]) * normal)
    return tangent, frame[:, 3:] * namespace(normal).linalg.cross(normal, tangent), normal

"""Residuals of images, whose normal equations need no Jacobian of the image's size."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeGuard

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import described, kind_of, shape_of
from rts.arrays.engine_base import Engine
from rts.arrays.engines import constants, context_of, engine_of, exemplar, namespace, stopped
from rts.arrays.trees import Array, Tree, map_leaves
from rts.contracts.checked_parts import CheckedPart, check_cameras, check_scene
from rts.contracts.checks import check_background, check_ratio, check_sampler, is_count, is_real
from rts.contracts.records import Sampled, Splats
from rts.contracts.residuals import Residuals
from rts.contracts.splatter import SummingSplatter
from rts.errors import InputError
from rts.fitting.losses import Loss
from rts.fitting.normal_equations import flatten, normal_equations
from rts.fitting.parameter_names import one_line
from rts.fitting.schedule import Stage, blurred, box_filtered
from rts.fitting.targets import (
    ZERO_UNMEASURED,
    by_name,
    checked_output,
    checked_target,
    checked_weights,
    measured,
    refuse_zero,
    shrunk,
    view_count,
    warn_of_gradients,
    weights_of_views,
)
from rts.plugin_base import overrides
from rts.rendering.arguments import BackgroundLike, Layers, SamplerLike, SplatterLike
from rts.rendering.image import over_background, render
from rts.rendering.outputs import Outputs
from rts.rendering.samples import sampled_scene
from rts.rendering.settings import RenderSettings
from rts.rendering.splats import owned, splats_of, to_splats
from rts.sampling.prepared import Prepared
from rts.sampling.scene import Grid, Scene
from rts.scene.camera import Camera
from rts.scene.parts import Part
from rts.splatting.channels import cropped_image
from rts.views.render_views import render_views
from rts.views.scenes import are_scenes

Parts = Part | Sequence[Part] | Prepared
Cameras = Camera | Sequence[Camera]
Scenes = Sequence[Sequence[Part] | Prepared]
SceneFunction = Callable[[Tree], "Parts | Scenes | tuple[Parts | Scenes, Cameras]"]


class ImageResiduals(Residuals):
    """The difference between the render of a scene and a target, as a function of the scene's parameters.

    Usable wherever a function of parameters is, such as with `rts.fit`. Levenberg–Marquardt takes less time and memory
    for it than for a function: derivatives along all unknowns are multiplied together as the image is swept.

    A target of B views is compared with B renders, as `rts.render_views` makes them.

    Args:
        scene: parameters → part, parts or the result of `prepare`; or a tuple of these and a camera, or cameras. Of
            several views it may give a list of scenes, one for each, as `rts.render_views` takes it.
        camera: the camera, if `scene` gives none; of several views a list, or the result of `Camera.stack`.
        size: (height, width) in pixels.
        target: (H, W) or (H, W, 1), compared with the image's alpha; (H, W, 3) with its premultiplied linear colours;
            or (H, W, 4) with both. Floating, or a bool mask; a constant. For 3 and 4 read C and C + 1 where the image
            has C channels. Of several views (B, H, W, ·), or a list. Or a dict of targets by the names of outputs of
            `rts.render`, such as {"color": …, "depth": …}; of several views each (B, H, W, ·), or a list of dicts.
            Residuals are then in one row. Those of means, such as depth, count as far as the pixel is covered: where
            nothing is seen, colours and alpha tell. A depth or a normal of 0 in the target is one that was not
            measured, and does not count.
        weights: factors on the differences, (H, W), (H, W, 1) or of the target's shape, such as a mask; or one number.
            Floating or bool; constants. Of several views (B, H, W, ·), or a list. For a dict of targets a dict, such as
            {"depth": 0.1}; outputs that it leaves out have 1.
        background: as in `render`; a constant, the same for every view.
        sampler: as in `render`.
        splatter: as in `render`.
        layers: as in `render`.
        supersample: as in `render`.
        capacity: as in `render`.
        channels: C of the image, as the scene's shaders say it. Where it is not 3, Levenberg–Marquardt takes the
            Jacobian.
        loss: the function of each residual, named as in `scipy.optimize.least_squares`: "linear" (its square), or
            "soft_l1", "huber" or "cauchy", to which large residuals count less: for targets that are partly wrong, such
            as a mask with something in front. Or an `rts.Loss`, which has its own `f_scale`.
        f_scale: the residual at which square turns into robust, in units of the image times weights; by default 0.1, as
            of every `rts.Loss`, which suits images in [0, 1].

    Attributes:
        size: (height, width).

    Raises:
        InputError: an argument of the wrong kind, shapes that do not fit, integers as target, or a target, weights or
            background that are not finite; alpha from 0 to 255; weights below zero, or all zero; another `loss`, or a
            scale that is no number from 1e-10 to 1e10.

    Warns:
        InputWarning: the target's colours are far beyond 1; or target, weights or background require a gradient.
    """

    def __init__(
        self,
        scene: SceneFunction,
        camera: Cameras | None,
        size: tuple[int, int],
        target: Array | Sequence[Array] | Mapping[str, Array],
        *,
        weights: Array | Sequence[Array] | Mapping[str, Array | float] | None = None,
        background: BackgroundLike = None,
        sampler: SamplerLike = "auto",
        splatter: SplatterLike = "auto",
        layers: Layers = "auto",
        supersample: int = 1,
        capacity: int | None = None,
        channels: int = 3,
        loss: str | Loss = "linear",
        f_scale: float | None = None,
    ):
        self._loss = _checked_loss(loss, f_scale)
        if not callable(scene):
            raise InputError(f"scene is {quoted(scene)}; expected a function: parameters → parts, or (parts, camera)")
        if camera is not None and not _are_cameras(camera):
            raise InputError(
                f"camera is {quoted(camera)}; expected an rts.Camera, or None where scene gives one, or several cameras"
            )
        self.size, self._settings = RenderSettings.checked(size, splatter, layers, supersample, capacity)
        self._scene, self._camera, self._sampler = scene, camera, check_sampler(sampler)
        if not is_count(channels):
            raise InputError(f"channels is {quoted(channels)}; expected an integer of at least 1")
        self._image_channels = channels
        self._background = check_background(background, self.size, channels)
        self._full, self._sigma = self.size, 0.0
        self._view: int | None = None
        self._outputs: tuple[str, ...] | None = None
        self._mean = False
        self._views: list[ImageResiduals] = []
        self._of_outputs: dict[str, ImageResiduals] = {}
        several = camera is not None and (not isinstance(camera, Camera) or camera.is_stacked)
        cameras = len(check_cameras(camera)) if several else None
        target, weights = by_name(target), by_name(weights, missing=1.0)
        if isinstance(target, Mapping):
            named = {f"target[{name!r}]": x for name, x in target.items()}
            warn_of_gradients(named | {"weights": weights, "background": background})
            views = [view_count(x, self.size, several) for x in target.values()] if camera is None else []
            count = next((count for count in views if count is not None), cameras)
            self._take_outputs(target, {} if weights is None else weights, count)
            of_views = self._views or [self]
            refuse_zero([child._weights for view in of_views for child in view._of_outputs.values()])
            return
        warn_of_gradients({"target": target, "weights": weights, "background": background})
        if (count := view_count(target, self.size, several)) is None:
            self._take(target, weights)
            refuse_zero([self._weights])
            if several:
                raise InputError(
                    f"there are {cameras} cameras for a target of one view; expected targets (B, H, W, ·), one for each"
                )
            return
        if cameras not in (None, count):
            raise InputError(f"there are {cameras} cameras for targets of {count} views; expected as many")
        for b, (view_target, factors) in enumerate(zip(target, weights_of_views(weights, count), strict=True)):
            view = copy(self)
            view._view, view._views = b, []
            view._take(view_target, factors)
            self._views.append(view)
        if len(kinds := {tuple(view._target.shape[2:]) for view in self._views}) > 1:
            raise InputError(f"targets of views have the channels {sorted(kinds)}; expected one kind for all views")
        refuse_zero([view._weights for view in self._views])

    @property
    def loss(self) -> Loss:  # pyright: ignore[reportIncompatibleVariableOverride]  # Never None, nor set.
        """The loss whose mean is minimised, the same for all stages and views."""
        return self._loss

    def _take(self, target: Any, weights: Any) -> None:
        """Set target and weights of one view, once checked. Shapes are those that the class says, without B."""
        self._target, self._channels = checked_target(target, self.size, self._image_channels)
        self._weights = checked_weights(weights, self._target.shape, self.size)

    def _take_outputs(self, target: Mapping[str, Any], weights: Any, views: int | None) -> None:
        """Set targets and weights of outputs by name, of one view or of `views`, once checked."""
        if not target:
            raise InputError("target is an empty dict; expected targets by names of outputs, such as {'depth': array}")
        outputs = Outputs(list(target))
        # The alpha of pixels weighs means.
        self._outputs = tuple(dict.fromkeys((*outputs.names, *(["alpha"] if outputs.means else []))))
        weights = dict.fromkeys(target, weights) if is_real(weights) else weights
        if not isinstance(weights, Mapping) or not set(weights) <= set(target):
            raise InputError(f"weights is {quoted(weights)}; expected a dict, by names of targets: {', '.join(target)}")
        if views is None:
            for name, of_output in target.items():
                child = self._of_outputs[name] = copy(self)
                child._of_outputs, child._background, child._mean = {}, None, name in outputs.means
                child._target = checked_output(name, of_output, self.size, self._image_channels)
                child._channels = 1 if len(child._target.shape) == 2 else child._target.shape[2]
                factors = weights.get(name)
                factors = checked_weights(factors, child._target.shape, self.size)
                child._weights = measured(child._target, factors) if name in ZERO_UNMEASURED else factors
            return
        for name, x in target.items():
            if (len(x) if isinstance(x, (list, tuple)) else (shape_of(x) or (0,))[0]) != views:
                raise InputError(
                    f"target[{name!r}] {described(x)}; expected those of {views} views, ({views}, H, W, ·)"
                )
        of_views = {name: weights_of_views(x, views) for name, x in weights.items()}
        for b in range(views):
            view = copy(self)
            view._view, view._views, view._of_outputs = b, [], {}
            factors = {name: x[b] for name, x in of_views.items()}
            view._take_outputs({name: x[b] for name, x in target.items()}, factors, None)
            self._views.append(view)

    def __call__(self, parameters: Tree) -> Array:
        """`weights * (image − target)`, of the target's shape, whatever the loss; blurred if a stage says so."""
        parts, camera = self.scene(parameters)
        options = {name: getattr(self._settings, name) for name in ("splatter", "layers", "supersample", "capacity")}
        options |= {"sampler": self._sampler, "background": self._background, "outputs": self._outputs}
        if not self._views:
            return self._difference(render(parts, camera, self.size, **options), parameters)
        images = render_views(parts, camera, self.size, **options)
        of_views = [
            view._difference(map_leaves(lambda x, b=b: x[b, ...], images), parameters)
            for b, view in enumerate(self._views)
        ]
        return namespace(of_views[0]).stack(of_views)

    def _difference(self, image: Any, parameters: Tree, share: Array | None = None) -> Array:
        """The residuals of one view, as of `__call__`, from its image (H, W, C + 1), or a dict of outputs.

        A `share` (H, W, 1) of each pixel counts; None for all.
        """
        if self._of_outputs:
            for name, child in self._of_outputs.items():
                count = image[name].shape[-1]
                if child._channels not in ((1, count - 1, count) if name == "color" else (count,)):
                    raise InputError(f"target[{name!r}] {described(child._target)}; expected {count} numbers a pixel")
            rows = []
            for name, child in self._of_outputs.items():
                found = child._difference(image[name], parameters, stopped(image["alpha"]) if child._mean else None)
                rows.append(namespace(found).reshape(found, (-1,)))
            return namespace(*rows).concat(rows)
        image = self._beside_target(image, parameters)
        target, weights, _ = self._constants(image)
        if self._outputs is None:
            self._refuse_other(image.shape[-1] - 1)
        # Alpha is last; a target of one channel is one of it alone.
        difference = image[..., -1:] if self._channels == 1 else image[..., : self._channels]
        difference = difference - target
        if weights is not None:
            difference = difference * weights
        if share is not None:
            difference = difference * constants(share, engine_of(difference), difference)
        if self._sigma:
            difference = blurred(difference, self._sigma)
        return namespace(image).reshape(difference, tuple(self._target.shape))

    def _refuse_other(self, channels: int) -> None:
        """Refuse images whose number of channels besides alpha is not the `channels` that the caller gave."""
        if channels != self._image_channels:
            raise InputError(
                f"the scene's shaders give {channels} channels besides alpha, and the target is for "
                f"{self._image_channels}; give channels={channels}, and a target for it"
            )

    def at_stage(self, stage: Stage) -> ImageResiduals:
        """The residuals at another resolution, for the same camera and extent of the image; see `rts.fit`.

        Target and background are box-filtered, the target's pixels by their squared weights. So an image that is
        constant over each coarse pixel has the same sum of squares as before, but for a constant. That holds for the
        loss "linear": a robust one is taken of the mean difference over a coarse pixel, times its weight. With a
        `sigma`, weighted differences are blurred, and Levenberg–Marquardt takes the Jacobian.

        Args:
            stage: the resolution, as a share of this one's.

        Returns:
            New residuals; the present ones stay as they are.
        """
        other = copy(self)
        other._views = [view.at_stage(stage) for view in self._views]
        other._of_outputs = {name: child.at_stage(stage) for name, child in self._of_outputs.items()}
        other._sigma = float(stage.sigma)
        if stage.supersample is not None:
            other._settings = replace(self._settings, supersample=stage.supersample)
        other.size = stage.size(self.size)
        if other.size != self.size:
            if not self._views and not self._of_outputs:
                other._target, other._weights = shrunk(self._target, self._weights, other.size)
            if self._background is not None and len(self._background.shape) == 3:
                other._background = box_filtered(self._background, other.size)
        return other

    def scene(self, parameters: Tree) -> tuple[Any, Any]:
        """Parts as the user's function gives them, and the camera; for targets of several views a list of cameras.

        Of residuals of one view among several, the camera is that view's. At a reduced resolution, cameras have no
        aspect of their own.

        Raises:
            InputError: other results of the function, no camera, or not one camera for each view.
        """
        parts, camera = self._scene_as_given(parameters)
        several = bool(self._views) or self._view is not None
        if are_scenes(parts):
            count = len(parts)
            if not several or (self._views and count != len(self._views)):
                targets = len(self._views) if several else "one view"
                raise InputError(f"scene gave {count} scenes for targets of {targets}; expected one for each view")
            parts = parts if self._view is None else parts[self._view]
        if not several and (not isinstance(camera, Camera) or camera.is_stacked):
            raise InputError("there are several cameras for a target of one view; expected targets (B, H, W, ·)")
        cameras: list[Any] = check_cameras(camera) if several else [camera]
        if self._views and len(cameras) != len(self._views):
            raise InputError(f"there are {len(cameras)} cameras for targets of {len(self._views)} views")
        cameras = cameras if self._view is None else [cameras[self._view]]
        if self.size != self._full:
            # Sides are rounded: the ratio of fewer pixels may differ, but the extent of the image is the same.
            for view_camera in cameras:
                check_ratio(view_camera, self._full)
            cameras = [view_camera.for_size(self._full).replace(aspect=None) for view_camera in cameras]
        return parts, cameras if self._views else cameras[0]

    def _scene_as_given(self, parameters: Tree) -> tuple[Any, Cameras]:
        scene = self._scene(parameters)
        if isinstance(scene, tuple) and len(scene) == 2 and _are_cameras(parts := scene[1]):
            return scene[0], parts
        parts = scene if isinstance(scene, (list, tuple)) else [scene]
        if are_scenes(parts):
            every = [part for own in parts for part in (own if isinstance(own, (list, tuple)) else [own])]
            parts = [] if any(not isinstance(own, Prepared) and not own for own in parts) else every
        if not parts or not all(isinstance(part, (Part, Prepared)) for part in parts):
            kinds = ", ".join(map(kind_of, parts)) or "nothing"
            raise InputError(
                f"scene gave {one_line(kinds)}; expected an rts.Part or several, or a tuple (parts, camera)"
            )
        if self._camera is None:
            raise InputError(
                "camera is None, and scene gives none; expected an rts.Camera, or (parts, camera) of scene"
            )
        return scene, self._camera

    @property
    def supersample(self) -> int:
        """Samples a pixel along each axis."""
        return self._settings.supersample

    @property
    def _ordinary(self) -> bool:
        """True unless a subclass computes other residuals."""
        return not overrides(self, "__call__", ImageResiduals)

    def normal_equations(self, parameters: Tree) -> tuple[Array, Array, Array]:
        """Mean loss () of the n residuals r, JᵀSJ / n (U, U) and JᵀWr / n (U,) for the U numbers in the parameters.

        J is the Jacobian of r. W and S are diagonals, ones for the loss "linear"; see `Loss.weights`. Of several views,
        means over the views. The Jacobian (n, U) is made only where it must be: of blurred images, of outputs by
        name, of images of other than 3 channels besides alpha, in subclasses, and for splatters that sum up none.
        """
        if self._views and self._ordinary:
            self.scene(parameters)  # Refused where there are not as many cameras.
            equations = [view.normal_equations(parameters) for view in self._views]
            value, matrix, gradient = (sum(x[1:], x[0]) / len(x) for x in zip(*equations, strict=True))
            return value, matrix, gradient
        engine, splatter = engine_of(parameters), self._settings.splatter
        if not (self._ordinary and self._outputs is None and engine.differentiates):
            return normal_equations(self, parameters, engine, self.loss)
        equations = None
        if isinstance(splatter, SummingSplatter) and not self._sigma and self._image_channels == 3:
            equations = self._swept(parameters, engine, splatter)
        if equations is None:  # Derivatives are of the samples, which are found once, without them.
            bands = [self._sampled(parameters, top, rows) for top, rows in self._settings.bands(self.size)]
            equations = normal_equations(partial(self._of_samples, bands), parameters, engine, self.loss)
        return equations

    def _sampled(self, parameters: Tree, top: int, rows: int) -> _Band:
        """The samples of a band of the image: of `rows` rows, from row `top` on."""
        parts, camera = self.scene(parameters)
        size = rows, self.size[1]

        def window(camera: Camera) -> Camera:
            camera = camera.for_size(self.size)
            # The ratio of a window is free.
            return camera if size == self.size else camera.window(self.size, (top, 0), size).replace(aspect=None)

        scene = Scene.of(parts, window(camera), self._sampler, None).at(size)
        self._refuse_other(scene.channels)
        settings = self._settings.of(scene)
        sampled = sampled_scene(scene, settings.grid(scene, scene.camera, size), settings)
        return _Band(top, rows, window, sampled, scene.parts)

    def _splats(self, band: _Band, parameters: Tree) -> Splats:
        """The splats of a band's samples at other values of the parameters."""
        parts, camera = _checked(*self.scene(parameters))
        context = context_of(parts, camera, band.sampled, parameters)
        grid = Grid.of_samples(band.sampled, parts, band.window(camera), context)
        return to_splats(band.sampled, parts, camera.for_size(self.size), grid, context)

    def _of_samples(self, bands: Sequence[_Band], parameters: Tree) -> Array:
        """The residuals, as of `__call__`, from samples of all bands."""
        splatter: Any = self._settings.splatter
        drawn = [cropped_image(splatter, self._splats(band, parameters)) for band in bands]
        image = drawn[0] if len(drawn) == 1 else namespace(*drawn).concat(drawn)
        return self._difference(over_background(image, self._background), parameters)

    def _swept(self, parameters: Tree, engine: Engine, splatter: SummingSplatter) -> tuple[Array, Array, Array] | None:
        """`normal_equations` without a Jacobian: by the splatter's method of that name, band by band.

        None where the splatter's method gives None.
        """
        total: list[Array] = []
        for top, rows in self._settings.bands(self.size):
            equations = self._swept_band(self._sampled(parameters, top, rows), parameters, engine, splatter)
            if equations is None:
                return None
            # Means over a band become shares of means over the image.
            shares = [x * (rows / self.size[0]) for x in equations]
            total = shares if not total else [a + b for a, b in zip(total, shares, strict=True)]
        value, matrix, gradient = total
        return value, matrix, gradient

    def _swept_band(
        self, band: _Band, parameters: Tree, engine: Engine, splatter: SummingSplatter
    ) -> tuple[Array, Array, Array] | None:
        """`normal_equations` of a band, with means over the band alone.

        None where the splatter's method gives None.
        """
        vector, unflatten = flatten(parameters)
        # Opaque samples have an alpha of one, whatever their colours.
        colored = self._channels > 1 or not all(part.shader.opaque for part in band.parts)
        fields = self._constants(vector)
        target, weights, background = (None if x is None else x[band.top : band.top + band.rows] for x in fields)

        def moved(v: Array) -> tuple[Array, Array]:
            shown = self._splats(band, unflatten(v))
            positions, rgba = constants((shown.positions, shown.rgba), engine, v)
            return positions, rgba if colored else engine.stop_gradient(rgba)

        (positions, rgba), (t_positions, t_rgba) = engine.jacobian(moved)(vector)
        context, cells = context_of(vector), {"border": band.sampled.border, "supersample": band.sampled.supersample}
        sampled = owned(band.sampled, band.sampled.row, context)
        known = constants(splats_of(sampled, band.parts, positions, rgba, context, **cells), engine, vector)
        loss = self.loss if self.loss.robust else None
        tangents = t_positions, t_rgba if colored else None
        return splatter.normal_equations(known, *tangents, target, weights, background, loss)

    def _beside_target(self, tree: Tree, parameters: Tree) -> Any:
        """The tree, its NumPy arrays moved to the engine of the parameters, or of the target if parameters are NumPy's.

        Raises:
            EngineError: torch and jax arrays meet.
        """
        images, like = (self._target, self._weights, self._background), exemplar(parameters)
        return constants(tree, engine_of(tree, parameters, images), exemplar(images) if like is None else like)

    def _constants(self, like: Array) -> tuple[Array, Array | None, Array | None]:
        """Target, weights and background without derivatives, in the engine of the array `like`.

        Returns:
            Target (H, W, c) of c channels, 1 for alpha alone; weights (H, W, 1 or c) or None; and the background
            (H, W, C + 1), opaque where it was given without alpha, or None.
        """
        engine = context_of(like, self._target, self._weights, self._background).engine
        fields = constants((self._target, self._weights, self._background), engine, like)
        xp = namespace(like)
        target, weights, background = (None if x is None else engine.stop_gradient(x) for x in fields)
        shape = *self.size, self._channels
        target = xp.reshape(target, shape)
        if weights is not None:
            weights = xp.reshape(weights, (*self.size, -1))
        if background is not None:
            if background.shape[-1] == self._image_channels:
                background = xp.concat([background, xp.ones_like(background[..., :1])], axis=-1)
            background = xp.broadcast_to(background, (*self.size, self._image_channels + 1))
        return target, weights, background


class _Band(NamedTuple):
    """Some rows of an image, sampled at some parameters.

    Attributes:
        top: the first row.
        rows: their number.
        window: camera of the image → that of the band.
        sampled: the samples.
        parts: checked parts, at the same parameters.
    """

    top: int
    rows: int
    window: Callable[[Camera], Camera]
    sampled: Sampled
    parts: Sequence[CheckedPart]


def _checked_loss(loss: Any, f_scale: Any) -> Loss:
    if not isinstance(loss, Loss):
        return Loss(loss) if f_scale is None else Loss(loss, f_scale)
    if f_scale is not None:
        raise InputError(f"loss is {loss}, and f_scale {quoted(f_scale)}; expected one of them to say the scale")
    return loss


def _are_cameras(value: Any) -> TypeGuard[Cameras]:
    """True for a camera, or a list or tuple of at least one."""
    cameras: list[Any] = list(value) if isinstance(value, (list, tuple)) else [value]
    return len(cameras) > 0 and all(isinstance(camera, Camera) for camera in cameras)


def _checked(parts: Parts, camera: Camera) -> tuple[list[CheckedPart], Camera]:
    return check_scene(parts.parts if isinstance(parts, Prepared) else parts, camera)

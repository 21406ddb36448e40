"""Lenses: focal lengths, principal point and distortion, and pictures as lenses without distortion would take them.

Positions in pictures are as everywhere in `rts`, and as in COLMAP: the centre of the first pixel is (0.5, 0.5).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import Polynomial

from rts.errors import InputError

MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}
"""Camera models by COLMAP's names, and their parameters in order."""
FISHEYE = "OPENCV_FISHEYE"
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Coefficients of distortion, in OpenCV's order."""
LEAST_FOCAL, LARGEST = 1e-6, 1e9
"""Least focal length, pixels, and the largest parameter of a lens."""
BAND = 32
"""Rows of a picture that are undistorted together: their positions stay in caches."""


@dataclass(frozen=True)
class Lens:
    """A lens: x and y, camera coordinates over depth, are distorted, scaled by fx and fy, and moved by cx and cy.

    Distortion is OpenCV's, and COLMAP's: with r² = x² + y²,
    x (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶) + 2 p1 x y + p2 (r² + 2 x²), and y likewise, with p1 and
    p2 exchanged. A fisheye's is x θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) / r, where r = tan θ.

    Attributes:
        fx: focal length, pixels.
        fy: focal length, pixels.
        cx: principal point, pixels; (0.5, 0.5) is the centre of the first pixel.
        cy: its y, downwards.
        fisheye: True for a fisheye, whose coefficients are k1 to k4.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    fisheye: bool = False

    @property
    def distorts(self) -> bool:
        """True if straight lines may be curved in its pictures."""
        return self.fisheye or any(getattr(self, name) for name in COEFFICIENTS)

    @property
    def matrix(self) -> np.ndarray:
        """(3, 3) OpenCV's K, but for the centre of the first pixel at (0.5, 0.5)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def scaled(self, x: float, y: float) -> Lens:
        """The lens for pictures that are x times as wide, and y times as high."""
        return replace(self, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)

    def distorted(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions, pixels, in pictures of this lens, of positions in pictures of the same lens without distortion.

        Positions beyond the lens's reach are NaN: there its polynomials turn back, and would show a place twice.
        """
        x, y = (x - self.cx) / self.fx, (y - self.cy) / self.fy
        s = x * x + y * y
        radial, tangential = self._radial(s), (self.p1, self.p2) if not self.fisheye else (0.0, 0.0)
        radial = np.where(s < self._reach(), radial, np.nan)
        p1, p2 = tangential
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x),
            y * radial + 2 * p2 * x * y + p1 * (s + 2 * y * y),
        )
        return self.fx * x + self.cx, self.fy * y + self.cy

    def _radial(self, s: np.ndarray) -> np.ndarray:
        """The factor of x and y, given r²."""
        if self.fisheye:
            r = np.sqrt(s)
            angle = np.arctan(r)
            polynomial = Polynomial([1, self.k1, self.k2, self.k3, self.k4])(angle * angle)
            return polynomial * np.where(r > 1e-9, angle / np.maximum(r, 1e-9), 1)
        over, under = self._fraction()
        with np.errstate(divide="ignore", invalid="ignore"):
            return over(s) / under(s)

    def _fraction(self) -> tuple[Polynomial, Polynomial]:
        """Numerator and denominator, in r², of the radial factor."""
        return Polynomial([1, self.k1, self.k2, self.k3]), Polynomial([1, self.k4, self.k5, self.k6])

    def _reach(self) -> float:
        """The r² up to which distances from the principal point grow with r, tangential distortion left aside."""
        if self.fisheye:
            growth = Polynomial([1, 3 * self.k1, 5 * self.k2, 7 * self.k3, 9 * self.k4])
            angle = math.sqrt(_first_root(growth))
            return math.tan(angle) ** 2 if angle < math.pi / 2 else math.inf
        over, under = self._fraction()
        growth = over * under + Polynomial([0, 2]) * (over.deriv() * under - over * under.deriv())
        return min(_first_root(growth), _first_root(under))


def lens_of(place: str, model: str, parameters: list[float]) -> Lens:
    """The lens of a camera model, by COLMAP's name and in its order of parameters.

    Raises:
        InputError: the model is not one of `MODELS`, or has another number of parameters; a parameter is not finite, or
            a focal length not positive.
    """
    check_model(place, model)
    names = MODELS[model].split()
    if len(parameters) != len(names):
        raise InputError(f"{place} has {len(parameters)} parameters; expected those of {model}: {', '.join(names)}")
    values = dict(zip(names, parameters, strict=True))
    if "f" in values:
        values["fx"] = values["fy"] = values.pop("f")
    return checked_lens(place, Lens(**values, fisheye=model == FISHEYE))


def check_model(place: str, model: object) -> None:
    """Refuse camera models that are not followed, by name."""
    if not isinstance(model, str) or model not in MODELS:
        raise InputError(
            f"{place} has the camera model {str(model)[:40]!r}, which is not followed; expected one of "
            f"{', '.join(MODELS)}: COLMAP's image_undistorter makes pictures of such a one"
        )


def checked_lens(place: str, lens: Lens) -> Lens:
    """The lens, refused where its numbers are too large or none, or a focal length is not positive."""
    for name in ("fx", "fy", "cx", "cy", *COEFFICIENTS):
        value, focal = getattr(lens, name), name in ("fx", "fy")
        if not (LEAST_FOCAL if focal else -LARGEST) <= value <= LARGEST:
            kind = "positive one, in pixels" if focal else "finite one"
            raise InputError(f"{place} has {name} = {value:g}; expected a {kind}, up to {LARGEST:g}")
    return lens


def undistorted(picture: np.ndarray, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """A picture as the lens without distortion takes it: of the same size, focal lengths and principal point.

    Args:
        picture: (H, W, C) float32, premultiplied if it has alpha.
        lens: the lens that took it.

    Returns:
        The picture, bilinear between pixels, and (H, W) float32: 1 where the picture is defined, 0 where it is not,
        since the lens would have taken this pixel from outside of the picture. There it is 0.
    """
    from scipy.ndimage import map_coordinates

    height, width, channels = picture.shape
    result, known = np.empty(picture.shape, np.float32), np.empty((height, width), np.float32)
    for start in range(0, height, BAND):
        band = slice(start, start + BAND)
        rows, columns = np.mgrid[start : min(start + BAND, height), :width]
        x, y = lens.distorted(columns + 0.5, rows + 0.5)
        defined = (x >= 0) & (x <= width) & (y >= 0) & (y <= height)  # NaN is not.
        place = np.where(defined, np.stack([y, x]) - 0.5, 0)
        for c in range(channels):
            result[band, :, c] = defined * map_coordinates(picture[..., c], place, order=1, mode="nearest")
        known[band] = defined
    return result, known


def _first_root(polynomial: Polynomial) -> float:
    """The smallest positive root of a polynomial that is 1 at 0; infinity without one."""
    # Inverses of roots: the coefficient that NumPy divides by is 1, where the last one may be tiny.
    inverses = Polynomial(polynomial.coef[::-1]).roots()
    real = inverses.real[(np.abs(inverses.imag) <= 1e-9 * np.abs(inverses)) & (inverses.real > 0)]
    return 1 / float(real.max()) if len(real) else math.inf

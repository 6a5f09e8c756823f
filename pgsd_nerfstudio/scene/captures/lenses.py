"""Lenses: where in a photograph a camera draws what a pinhole of the same focal length would draw.

Rasterizers of Gaussians know pinholes only, so a photograph is compared with a render through the pinhole that has the focal
lengths and the principal point of its lens. The models and their formulas are those of COLMAP 4 (src/colmap/sensor/models.h),
under COLMAP's names, which transforms.json uses too: Brown (1971) with OpenCV's rational radial term; fisheyes after Kannala
and Brandt (2006) with OpenCV's thin prisms; FOV of Devernay and Faugeras (2001); division of Fitzgibbon (2001); the enhanced
unified camera of Khomutenko et al. (2016).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.errors import SceneError

MODELS: Mapping[str, tuple[str, str]] = {
    "SIMPLE_PINHOLE": ("perspective", "f cx cy"),
    "PINHOLE": ("perspective", "fx fy cx cy"),
    "SIMPLE_RADIAL": ("perspective", "f cx cy k1"),
    "RADIAL": ("perspective", "f cx cy k1 k2"),
    "OPENCV": ("perspective", "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": ("fisheye", "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": ("perspective", "fx fy cx cy k1 k2 p1 p2 k3 d1 d2 d3"),
    "FOV": ("fov", "fx fy cx cy omega"),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", "f cx cy k1"),
    "RADIAL_FISHEYE": ("fisheye", "f cx cy k1 k2"),
    "THIN_PRISM_FISHEYE": ("fisheye", "fx fy cx cy k1 k2 p1 p2 k3 k4 s1 s2"),
    "RAD_TAN_THIN_PRISM_FISHEYE": ("", ""),
    "SIMPLE_DIVISION": ("division", "f cx cy k"),
    "DIVISION": ("division", "fx fy cx cy k"),
    "SIMPLE_FISHEYE": ("fisheye", "f cx cy"),
    "FISHEYE": ("fisheye", "fx fy cx cy"),
    "EUCM": ("eucm", "fx fy cx cy alpha beta"),
    "EQUIRECTANGULAR": ("", ""),
}
"""COLMAP 4.2's models in the order of their numbers: the projection, empty where it is not read, and the parameters."""
READ = tuple(name for name, (projection, _) in MODELS.items() if projection)

MOST_PIXELS = 100_000  # of a side
MOST_FOCAL = 1e7  # pixels
RADII = 2048  # samples along the radius, to find where a lens folds over


@dataclass(frozen=True)
class Lens:
    """A camera's image in pixels (pixel centres at half-integers), and how its optics bend it."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    projection: str = "perspective"
    """perspective, fisheye, fov, division or eucm."""
    radial: tuple[float, ...] = ()
    """Coefficients of r^2, r^4, ...; r is the tangent of the angle to the axis, for fisheyes the angle in radians."""
    divisor: tuple[float, ...] = ()
    """Coefficients of r^2, r^4, ... of the polynomial that divides the radial one."""
    tangential: tuple[float, float] = (0.0, 0.0)
    prism: tuple[float, float] = (0.0, 0.0)
    shape: tuple[float, ...] = ()
    """omega of fov (radians), k of division, alpha and beta of eucm."""

    @property
    def straight(self) -> bool:
        """Whether the lens draws as a pinhole does."""
        return self.projection == "perspective" and not any((*self.radial, *self.divisor, *self.tangential, *self.prism))

    @property
    def K(self) -> Float64[Tensor, "3 3"]:
        """Intrinsics of the pinhole with this focal length and principal point, in pixels."""
        return torch.tensor([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=torch.float64)

    def pixels(self, points: Float[Tensor, "*n 2"]) -> tuple[Float[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
        """Where the lens draws points.

        Args:
            points: x / z and y / z in the axes of the camera (x right, y down, z forward).

        Returns:
            Pixels, and whether the lens draws the point at all: not beyond the radius at which its formula folds over.
        """
        if self.straight:
            bent, drawn = points, torch.ones_like(points[..., 0], dtype=torch.bool)
        else:
            bent = self._bent(points)
            radius = points.norm(dim=-1)
            drawn = torch.isfinite(bent).all(-1) & (radius <= self._fold(float(radius.max()) if radius.numel() else 0.0))
        scale = torch.tensor([self.fx, self.fy]).to(points)
        return bent * scale + torch.tensor([self.cx, self.cy]).to(points), drawn

    def _bent(self, points: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 2"]:
        r2 = points.square().sum(-1, keepdim=True)
        if self.projection == "eucm":
            alpha, beta = self.shape
            return points / (alpha * (beta * r2 + 1).sqrt() + (1 - alpha))
        if self.projection == "division":
            return points * 2 / (1 + (1 - 4 * self.shape[0] * r2).sqrt())
        r = r2.sqrt().clamp_min(1e-12)
        if self.projection == "fov":
            (omega,) = self.shape
            return points * (torch.atan(2 * math.tan(omega / 2) * r) / (omega * r) if omega else 1.0)
        if self.projection == "fisheye":
            points = points * torch.atan(r) / r
            r2 = points.square().sum(-1, keepdim=True)
        x, y = points[..., :1], points[..., 1:]
        (p1, p2), (s1, s2) = self.tangential, self.prism
        across = torch.cat([2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], dim=-1)
        thin = torch.cat([s1 * r2, s2 * r2], dim=-1)
        return points * _polynomial(self.radial, r2) / _polynomial(self.divisor, r2) + across + thin

    def _fold(self, most: float) -> float:
        """The radius, at most `most`, up to which points further out are drawn further out."""
        radii = torch.linspace(0.0, max(most, 1e-6), RADII, dtype=torch.float64)
        along = self._bent(torch.stack([radii, torch.zeros_like(radii)], dim=-1))[:, 0]
        rising = along.diff() > 0
        return most if bool(rising.all()) else float(radii[int((~rising).to(torch.uint8).argmax())])


def _polynomial(coefficients: Sequence[float], r2: Float[Tensor, "*n 1"]) -> Float[Tensor, "*n 1"]:
    """1 + c1 r^2 + c2 r^4 + ..."""
    value = torch.zeros_like(r2)
    for coefficient in reversed(coefficients):
        value = (value + coefficient) * r2
    return value + 1


def lens_of(model: str, width: float, height: float, values: Mapping[str, float], whose: str) -> Lens:
    """A lens from named parameters.

    Args:
        model: COLMAP's name.
        width: of the image in pixels.
        height: of the image in pixels.
        values: parameters by the names in `MODELS`; further radial coefficients k1 to k4 count too, absent ones are zero.
        whose: whose lens it is, with the file, for messages.

    Raises:
        SceneError: the model is not known, or a number cannot be that of a camera.
    """
    if model not in READ:
        raise SceneError(
            f"{whose} was taken with a {model} camera, which no pinhole can stand for (known are {', '.join(READ)}): cut "
            "panoramas into perspective views, undistort the rest"
        )
    projection = MODELS[model][0]
    fx, fy = (values.get("f", values.get(name, math.nan)) for name in ("fx", "fy"))
    numbers = {"w": width, "h": height, "fl_x": fx, "fl_y": fy, "cx": values["cx"], "cy": values["cy"]}
    numbers |= {name: value for name, value in values.items() if name not in ("f", "fx", "fy", "cx", "cy")}
    for name, value in numbers.items():
        most = MOST_FOCAL if name.startswith("fl") else MOST_PIXELS
        least = {"w": 1.0, "h": 1.0, "fl_x": 1e-3, "fl_y": 1e-3}.get(name, -most)
        if not least <= value <= most:
            raise SceneError(f"{whose} cannot be that of a camera: expected {name} from {least:g} to {most:g}, found {value:g}")
    shape = {"fov": ("omega",), "division": ("k",), "eucm": ("alpha", "beta")}.get(projection, ())
    return Lens(
        int(width),
        int(height),
        float(fx),
        float(fy),
        float(values["cx"]),
        float(values["cy"]),
        projection,
        _until_zero(values, "k1", "k2", "k3", "k4") if not shape else (),
        _until_zero(values, "d1", "d2", "d3"),
        (float(values.get("p1", 0.0)), float(values.get("p2", 0.0))),
        (float(values.get("s1", 0.0)), float(values.get("s2", 0.0))),
        tuple(float(values[name]) for name in shape),
    )


def pinhole(camera: Cameras) -> Lens:
    """The lens of a photograph that was taken with the camera itself.

    Args:
        camera: one.
    """
    (fx, _, cx), (_, fy, cy), _ = camera.Ks[0].tolist()
    return Lens(camera.width, camera.height, fx, fy, cx, cy)


def _until_zero(values: Mapping[str, float], *names: str) -> tuple[float, ...]:
    """The named coefficients, without the zeros at the end."""
    found = [float(values.get(name, 0.0)) for name in names]
    while found and found[-1] == 0.0:
        found.pop()
    return tuple(found)

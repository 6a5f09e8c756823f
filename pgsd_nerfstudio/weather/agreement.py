"""Whether a splat and its cameras are in the same coordinates: renders of some views look like their photographs.

Files do not say in which coordinates a splat is, and a splat in other ones than its cameras gives a smear and no error. So a
few small renders are compared with the photographs, and where they do not agree the cameras are tried at the places where
splats of such a capture are found (`scene.captures.placements`).

The measure is a correlation of grey values between two blurs, which exposure, white balance and missing backgrounds do not
touch. On a photographed garden its median over views is 0.90 with the right cameras, 0.75 with cameras turned by 2 degrees, and
between -0.1 and 0.3 with cameras that are turned by 10 degrees, shifted by a tenth of their distance, or in other axes
(scripts/compare_cameras.py).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from statistics import median

import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter
from torch import Tensor

from pgsd_nerfstudio.rendering.rasterizer import Rasterizer
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.captures.photographs import read_photograph
from pgsd_nerfstudio.scene.scene import Scene, SceneError

VIEWS = 5  # that are compared
SIDE = 160  # pixels along the longer side
FINE, COARSE = 2.0, 12.0  # standard deviations of the two blurs in pixels of SIDE
AGREES = 0.4  # median correlation from which on cameras count as right: poor splats of right cameras have 0.5
DOUBTED = 0.6  # below that, cameras may be turned by some degrees, and it is said so
LEAST_CONTRAST = 0.01  # between the blurs; a plain wall tells nothing
LEAST_COVERED = 0.02  # of the picture that the splat must cover


@dataclass(frozen=True)
class Likeness:
    """How much renders look like photographs: medians over the views that could be compared."""

    correlation: float
    """-1..1, of grey values between the two blurs."""
    psnr: float
    """In dB."""
    views: int


def likeness_of(scene: Scene, rasterizer: Rasterizer, device: torch.device) -> Likeness | None:
    """How much renders of some views look like their photographs; None where there are none that show something.

    Args:
        scene: its cameras are taken as they are.
        rasterizer: of its Gaussians.
        device: of the rasterizer.

    Raises:
        SceneError: a photograph cannot be read.
    """
    return _compared(scene, _photographs(scene), rasterizer, device)


def agreed(scene: Scene, rasterizer: Rasterizer, device: torch.device) -> Scene:
    """The scene with its cameras where renders look like the photographs.

    Without photographs, or where these show nothing to go by, the cameras stay as they are.

    Args:
        scene: as `scene.loading.read_scene` returns it.
        rasterizer: of its Gaussians.
        device: of the rasterizer.

    Raises:
        SceneError: renders look like the photographs at no place that is known; the sentence says what was tried.
    """
    if scene.trusted:
        return scene
    photographs = _photographs(scene)
    found = _compared(scene, photographs, rasterizer, device)
    if found is None:
        return scene
    if found.correlation >= AGREES:
        said = f"renders of {found.views} views look like their photographs ({_told(found)})"
        if found.correlation < DOUBTED:
            said += ", but not quite: are these the cameras that the splat was trained on?"
        return replace(scene, trusted=True, placements=(), remarks=(*scene.remarks, said))
    best: tuple[Likeness, Scene, str] | None = None
    for placement in scene.placements:
        try:
            elsewhere = scene.placed(placement)
        except (ValueError, RuntimeError):  # no metric frame follows from cameras there
            continue
        likeness = _compared(elsewhere, photographs, rasterizer, device)
        if likeness is not None and (best is None or likeness.correlation > best[0].correlation):
            best = likeness, elsewhere, placement.name
    if best is not None and best[0].correlation >= AGREES:
        said = (
            f"as they are in the file, the cameras do not fit the splat ({_told(found)}): they are {best[2]}, where renders "
            f"look like their photographs ({_told(best[0])})"
        )
        return replace(best[1], trusted=True, remarks=(*scene.remarks, said))
    tried = "".join(f"; {placement.name}" for placement in scene.placements)
    raise SceneError(
        f"the cameras do not fit the splat: renders of {found.views} views do not look like their photographs ({_told(found)}, "
        f"expected at least {AGREES:g}){', nor with the cameras ' + tried[2:] if tried else ''}: pass data= with the cameras "
        "that the splat was trained on, or trust_cameras=True to go on all the same"
    )


def _told(likeness: Likeness) -> str:
    return f"PSNR {likeness.psnr:.1f} dB, correlation {likeness.correlation:.2f}"


Picture = tuple[int, Float[Tensor, "h w 3"], Float[Tensor, "h w"]]
"""Number of a view, its photograph, and 1 where the photograph is known and opaque."""


def _small(cameras: Cameras) -> Cameras:
    zoom = min(1.0, SIDE / max(cameras.width, cameras.height))
    return cameras.resized(max(1, round(cameras.width * zoom)), max(1, round(cameras.height * zoom)))


def _photographs(scene: Scene) -> list[Picture]:
    """Some photographs that are there and show something, evenly chosen and small."""
    there = scene.photographed()
    chosen = [there[int(k)] for k in torch.linspace(0, len(there) - 1, min(VIEWS, len(there))).round()] if there else []
    cameras, found = _small(scene.cameras), []
    for index in chosen:
        seen = read_photograph(scene.photographs[index], cameras[index])
        known = seen.known * seen.opacity
        if float(_detail(seen.rgb.mean(-1), known).square().mul(known).sum() / known.sum().clamp_min(1.0)) >= LEAST_CONTRAST**2:
            found.append((index, seen.rgb, known))
    return found


def _compared(scene: Scene, photographs: list[Picture], rasterizer: Rasterizer, device: torch.device) -> Likeness | None:
    """None where there is nothing to compare."""
    if not photographs:
        return None
    cameras, correlations, psnrs = _small(scene.cameras), [], []
    for index, photograph, known in photographs:
        with torch.no_grad():
            rendering = rasterizer.render(cameras[index].to(device))
        render, weight = rendering.rgb[0].clamp(0, 1).cpu(), rendering.accumulation[0].clamp(0, 1).cpu() * known
        correlations.append(_correlation(render, photograph, weight))
        error = ((render - photograph).square().mean(-1) * known).sum() / known.sum()
        psnrs.append(float(-10 * error.clamp_min(1e-10).log10()))
    return Likeness(median(correlations), median(psnrs), len(photographs))


def _correlation(render: Float[Tensor, "h w 3"], photograph: Float[Tensor, "h w 3"], weight: Float[Tensor, "h w"]) -> float:
    """Of the details of two pictures where the splat covers the view; 0 where it hardly does."""
    if float(weight.mean()) < LEAST_COVERED:
        return 0.0
    ours, theirs = (_detail(picture.mean(-1), weight) for picture in (render, photograph))
    norm = (weight * ours.square()).sum().sqrt() * (weight * theirs.square()).sum().sqrt()
    return float((weight * ours * theirs).sum() / norm.clamp_min(1e-9))


def _detail(grey: Float[Tensor, "h w"], weight: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """What lies between the two blurs, each over the weighted pixels only."""
    share = max(grey.shape) / SIDE
    fine, coarse = (_blurred(grey * weight, s * share) / _blurred(weight, s * share).clamp_min(1e-6) for s in (FINE, COARSE))
    return fine - coarse


def _blurred(picture: Float[Tensor, "h w"], sigma: float) -> Float[Tensor, "h w"]:
    """Convolved with a Gaussian; beyond its edges the picture is zero."""
    # In one thread: pictures are so small that torch's threads would mostly wait for each other.
    return torch.from_numpy(gaussian_filter(picture.numpy(), sigma, mode="constant", truncate=3.0))

"""What an image editor made of the training views, as a change of the frozen scene.

The paper fine-tunes the background on pictures of it under snow: 1000 iterations over scale, opacity and colour of its
Gaussians, which are then interpolated over time. Here the same three quantities are fitted, but as a change that is kept beside
the scene: the scene's own tensors stay as they are, and any share of the change can be shown. The loss is that of Kerbl et al.,
"3D Gaussian Splatting for Real-Time Radiance Field Rendering" (2023), eq. 7.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import Tensor

from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.rendering.spherical_harmonics import SH_C0, sh_basis, view_colors
from pgsd_nerfstudio.response.edited_pictures import Picture
from pgsd_nerfstudio.response.edits import Edits
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.storage import content_key, load_tensors, save_tensors

# Of 3DGS but for the colour, which there moves by 0.0007 a step: too slow to whiten anything dark in 1000 steps.
RATES = {"rgb": 0.02, "logit": 0.03, "log_scale": 0.005}  # of learning, at the first step
LAST_RATE = 0.1  # share of the first that is left at the last step
BOUNDS = {"logit": 6.0, "log_scale": 1.5}  # largest change of either sign
HOLD = {"logit": 1e-2, "log_scale": 1e-1}  # pixels wrong by 1 that a change of 1 squared costs, for each Gaussian
SIMILARITY = 0.2  # share of structural similarity in the loss
SEEN = 0.02  # pixels that a Gaussian must light up in one of the views; what shows less is not judged by them
STEADY = 0.02  # pixels; Adam's eps: what shows less is moved in proportion, not at the full rate
LEAST_SIDE = 16  # pixels; structural similarity looks at 11 at once
CPU_SIDE = 256  # pixels of the longer side of the pictures on a CPU
STORE_EVERY = 50  # steps that an interruption may cost
MAX_SKIPPED = 5  # steps in a row that may pass without a gradient
MOMENTS = ("exp_avg", "exp_avg_sq")  # what Adam keeps of each number
_REVISION = 1  # of what is fitted; what an earlier revision has stored is not used

console = Console(stderr=True, highlight=False)


def edits_key(
    scene: Scene,
    pictures: Sequence[Picture],
    *,
    steps: int = 1000,
    seed: int = 0,
    device: torch.device | str = "cpu",
    side: int | None = None,
) -> str:
    """Hash of everything that a change is fitted from; arguments as for `fit_edits`."""
    side = CPU_SIDE if side is None and torch.device(device).type == "cpu" else side
    return content_key("edits", _REVISION, scene.gaussians, scene.cameras, list(pictures), steps, seed, side)


def fit_edits(
    scene: Scene,
    pictures: Sequence[Picture],
    *,
    steps: int = 1000,
    seed: int = 0,
    device: torch.device | str = "cpu",
    side: int | None = None,
    progress: bool = True,
    resume: Path | None = None,
) -> Edits:
    """The change that makes the scene look like the pictures; zero for every Gaussian that none of their views shows.

    Args:
        steps: one of the views each, every view once before any comes again.
        side: pixels of the longer side of the pictures at work; None: CPU_SIDE on a CPU, as they are with CUDA.
        progress: show a bar.
        resume: file that keeps where the fit stands, every STORE_EVERY steps until it is complete; a fit that was broken off
            goes on from there and ends with the same bits (on a CPU, and with as many threads).

    Raises:
        ValueError: there are no pictures, one is of no view or not uint8 in the size of the cameras, no Gaussian is seen in
            them, or `steps` or `side` is too small.
        FloatingPointError: several steps in a row gave no finite gradient.
    """
    _check(scene, pictures, steps, side)
    device = torch.device(device)
    key = edits_key(scene, pictures, steps=steps, seed=seed, device=device, side=side)
    side = CPU_SIDE if side is None and device.type == "cpu" else side
    gaussians = scene.gaussians.detach().to(device)
    with _bar(progress) as bar:
        looking = bar.add_task("looking at the views", total=len(pictures), loss="")
        views = _Views.of(gaussians, scene.cameras, pictures, side, lambda: bar.advance(looking))
        fit = _Fit(gaussians, views)
        if resume is not None:
            fit.restore(resume, key)
        fitting = bar.add_task("fitting the edited views", total=steps, completed=fit.done, loss="")
        while fit.done < steps:
            loss = fit.step(_view_at(fit.done, len(pictures), seed), LAST_RATE ** (fit.done / steps))
            bar.update(fitting, completed=fit.done, loss=f"loss {loss:.4f}")
            if resume is not None and fit.done % STORE_EVERY == 0 and fit.done < steps and not fit.store(resume, key):
                console.print(f"[yellow]could not store step {fit.done} in {resume}: going on[/]", soft_wrap=True)
                resume = None
    if fit.skipped:
        console.print(f"[yellow]{fit.skipped} of {steps} steps had no finite gradient and changed nothing[/]")
    if resume is not None:
        with suppress(OSError):  # never stored, or of a disk that is gone
            resume.unlink()
    return fit.edits(len(gaussians)).to("cpu")


def _check(scene: Scene, pictures: Sequence[Picture], steps: int, side: int | None) -> None:
    if not pictures:
        raise ValueError("a change is fitted to at least one edited picture, found none")
    if steps < 1 or (side is not None and side < LEAST_SIDE):
        raise ValueError(f"steps must be at least 1 and side at least {LEAST_SIDE} pixels, found steps={steps}, side={side}")
    for index, picture in pictures:
        if not 0 <= index < len(scene.cameras):
            raise ValueError(f"the scene has the views 0 to {len(scene.cameras) - 1}, found a picture of view {index}")
        expected = [scene.cameras.height, scene.cameras.width, 3]
        if picture.dtype != torch.uint8 or list(picture.shape) != expected:
            raise ValueError(
                f"the picture of view {index} must be uint8 {expected}, found {picture.dtype} {list(picture.shape)}"
            )


def _view_at(step: int, count: int, seed: int) -> int:
    """The view of a step: all in random order, then all in another; a function of seed and step, so nothing need be kept."""
    generator = torch.Generator().manual_seed(seed + 1_000_003 * (step // count))
    return int(torch.randperm(count, generator=generator)[step % count])


@dataclass(frozen=True)
class _Views:
    """The edited views in the size they are worked on in."""

    cameras: Cameras
    targets: list[Float[Tensor, "h w 3"]]
    """Half precision, on the CPU."""
    seen: Bool[Tensor, " n"]
    """The Gaussians that light up at least SEEN pixels in one of them."""

    @staticmethod
    def of(
        gaussians: Gaussians, cameras: Cameras, pictures: Sequence[Picture], side: int | None, advance: Callable[[], object]
    ) -> _Views:
        cameras = cameras[torch.tensor([index for index, _ in pictures])]
        small = _shrunk(cameras, side)
        most, targets = torch.zeros(len(gaussians), device=gaussians.device), []
        rasterizer = choose_rasterizer(Gaussians.empty(), gaussians.device)
        for k, (_, picture) in enumerate(pictures):
            target = picture.to(gaussians.device) / 255
            colors = view_colors(gaussians.colors, gaussians.means, small.viewmats[k]).clone().requires_grad_()
            shown = rasterizer.render(small[k], replace(gaussians, colors=colors)).rgb[0]
            # What a picture gains with a Gaussian's red is the light that comes from it.
            (light,) = torch.autograd.grad(shown[..., 0].sum(), colors)
            most = torch.maximum(most, light[:, 0])
            if small.width != cameras.width:
                # Gaussians look wider where pixels are larger. So that this is not taken for an edit, the small picture is
                # that of the scene and what the editor changed.
                with torch.no_grad():
                    change = target - rasterizer.render(cameras[k], gaussians).rgb[0]
                target = shown.detach() + _averaged(change, small.width, small.height)
            targets.append(target.half().cpu())
            advance()
        return _Views(small, targets, most >= SEEN)


def _shrunk(cameras: Cameras, side: int | None) -> Cameras:
    """The same views with at most `side` pixels along the longer side, whole: less than a pixel is lost by stretching."""
    zoom = 1.0 if side is None else min(1.0, side / max(cameras.width, cameras.height))
    width, height = (max(LEAST_SIDE, round(zoom * length)) for length in (cameras.width, cameras.height))
    stretch = torch.tensor([width / cameras.width, height / cameras.height, 1.0])
    return Cameras(cameras.viewmats, cameras.Ks * stretch.to(cameras.Ks)[:, None], width, height)


def _averaged(picture: Float[Tensor, "h w 3"], width: int, height: int) -> Float[Tensor, "height width 3"]:
    small = torch.nn.functional.interpolate(picture.permute(2, 0, 1)[None], (height, width), mode="area")
    return small[0].permute(1, 2, 0)


class _Fit:
    """The descent: a change of those Gaussians that are seen, among the others."""

    def __init__(self, gaussians: Gaussians, views: _Views) -> None:
        self.views = views
        self.ids = views.seen.nonzero()[:, 0]
        if len(self.ids) == 0:
            raise ValueError(f"none of the {len(gaussians):,} Gaussians is seen in the {len(views.cameras)} edited views")
        self.scene = gaussians.select(self.ids)
        self.rasterizer = choose_rasterizer(gaussians.select(~views.seen), gaussians.device)
        shapes = {"rgb": (3,), "logit": (), "log_scale": (3,)}
        self.change = {
            name: torch.zeros(len(self.ids), *shape, device=gaussians.device, requires_grad=True)
            for name, shape in shapes.items()
        }
        groups = [{"params": [tensor], "name": name} for name, tensor in self.change.items()]
        self.optimizer = torch.optim.Adam(groups, eps=STEADY, fused=True)
        self.done = self.skipped = self.in_a_row = 0

    def step(self, view: int, rate: float) -> float:
        """Descend by one view at a share of the full rates; returns its loss."""
        edited = Edits(**self.change).applied(self.scene, 1.0)
        camera = self.views.cameras[view]
        shown = self.rasterizer.render(camera, replace(edited, colors=_liftable(edited, camera.viewmats[0]))).rgb[0]
        loss = difference(shown, self.views.targets[view].to(shown))
        held = sum(weight * self.change[name].square().sum() for name, weight in HOLD.items())
        self.optimizer.zero_grad()
        (loss * shown[..., 0].numel() + held).backward()
        self.done += 1
        if self._finite():
            for group in self.optimizer.param_groups:
                group["lr"] = RATES[group["name"]] * rate
            self.optimizer.step()
            self._bound()
        return float(loss.detach())

    def _finite(self) -> bool:
        """Whether the gradient is finite; counts if it is not.

        Raises:
            FloatingPointError: it was not, several times in a row.
        """
        sums = torch.stack([tensor.grad.sum() for tensor in self.change.values() if tensor.grad is not None])
        if torch.isfinite(sums).all():
            self.in_a_row = 0
            return True
        self.skipped, self.in_a_row = self.skipped + 1, self.in_a_row + 1
        if self.in_a_row == MAX_SKIPPED:
            raise FloatingPointError(
                f"the gradient of the edited views was NaN or infinite in {MAX_SKIPPED} steps in a row, up to step {self.done}"
            )
        return False

    @torch.no_grad()
    def _bound(self) -> None:
        # A colour without its dependence on the direction goes no further out of 0..1 than it is.
        constant = SH_C0 * self.scene.colors[:, 0] + 0.5
        self.change["rgb"].clamp_(-constant.clamp_min(0), (1 - constant).clamp_min(0))
        for name, bound in BOUNDS.items():
            self.change[name].clamp_(-bound, bound)

    def edits(self, count: int) -> Edits:
        """The change of all `count` Gaussians of the scene: of those that are not seen, zero."""
        found = {}
        for name, tensor in self.change.items():
            found[name] = tensor.new_zeros(count, *tensor.shape[1:])
            found[name][self.ids] = tensor.detach()
        return Edits(**found)

    def store(self, path: Path, key: str) -> bool:
        """Keep where the fit stands; False where the disk does not take it."""
        tensors = dict(self.change)
        for name, tensor in self.change.items():
            moments = self.optimizer.state[tensor]
            tensors |= {f"{name}.{moment}": moments.get(moment, torch.zeros_like(tensor)) for moment in MOMENTS}
        numbers = {"done": self.done, "skipped": self.skipped, "in_a_row": self.in_a_row}
        with suppress(OSError):
            save_tensors(path, tensors, {"key": key, **numbers})
            return True
        return False

    @torch.no_grad()
    def restore(self, path: Path, key: str) -> None:
        """Go on from what is kept, if it is of the same fit."""
        stored = load_tensors(path)
        if stored is None or stored[1].get("key") != key:
            return
        tensors, about = stored
        self.done, self.skipped, self.in_a_row = (about[name] for name in ("done", "skipped", "in_a_row"))
        for name, tensor in self.change.items():
            tensor.copy_(tensors[name])
            moments = {moment: tensors[f"{name}.{moment}"].to(tensor) for moment in MOMENTS}
            steps = torch.tensor(float(self.done - self.skipped), device=tensor.device)
            self.optimizer.state[tensor] = {"step": steps, **moments}


def _liftable(gaussians: Gaussians, viewmat: Float[Tensor, "4 4"]) -> Float[Tensor, "n 3"]:
    """`view_colors` with a gradient also where they are cut off at black: a tenth of the Gaussians of a capture are darker than
    black from some side, and must whiten too."""
    center = torch.linalg.inv(viewmat.double())[:3, 3].to(gaussians.means)
    basis = sh_basis(gaussians.sh_degree or 0, torch.nn.functional.normalize(gaussians.means - center, dim=1))
    colors = torch.einsum("nk,nkc->nc", basis, gaussians.colors) + 0.5
    return colors + (colors.clamp_min(0) - colors).detach()


def difference(shown: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """Mean absolute difference of the pixels, with a share of structural dissimilarity; 0 for equal pictures."""
    from torchmetrics.functional.image import structural_similarity_index_measure as similarity  # takes seconds to import

    ours, theirs = (picture.permute(2, 0, 1)[None] for picture in (shown, target))
    alike = similarity(ours, theirs, data_range=1.0)
    assert isinstance(alike, Tensor)
    return (1 - SIMILARITY) * (shown - target).abs().mean() + SIMILARITY * (1 - alike)


def _bar(show: bool) -> Progress:
    counts = BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[loss]}"), TimeElapsedColumn(), TimeRemainingColumn()
    return Progress(TextColumn("{task.description}"), *counts, console=console, disable=not show, transient=True)

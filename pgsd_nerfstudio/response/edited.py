"""Fit edits of the frozen scene to training views that an image editor has changed.

The paper fine-tunes the background on pictures of it under snow: 1000 iterations over scale, opacity and colour of its
Gaussians, which are then interpolated over time. This module fits the same three quantities as edits apart from the scene, so
that the scene's own tensors stay as they are and any share of the edits can be shown. The loss is that of Kerbl et al.,
"3D Gaussian Splatting for Real-Time Radiance Field Rendering" (2023), eq. 7.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import Tensor

from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.response.edited_pictures import Picture
from pgsd_nerfstudio.response.edited_views import LEAST_SIDE, EditedViews
from pgsd_nerfstudio.response.edits import Edits
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.scene.spherical_harmonics import SH_C0, sh_basis
from pgsd_nerfstudio.storage import content_key, load_tensors, save_tensors

# The rates of 3DGS except for the colour, whose 0.0007 a step is too slow to whiten dark surfaces in 1000 steps.
RATES = {"rgb": 0.02, "logit": 0.03, "log_scale": 0.005}  # learning rates at the first step
LAST_RATE = 0.1  # learning rates at the last step relative to those at the first
BOUNDS = {"logit": 6.0, "log_scale": 1.5}  # largest change of either sign
HOLD = {"logit": 1e-2, "log_scale": 1e-1}  # penalty of a squared change of 1 of a Gaussian, in pixels that are wrong by 1
SIMILARITY = 0.2  # share of structural similarity in the loss
STEADY = 0.02  # pixels; eps of Adam: Gaussians that light up less than this move in proportion and not at the full rate
CPU_SIDE = 256  # pixels of the longer side of the pictures on a CPU
STORE_EVERY = 50  # steps; an interruption costs no more than these
MAX_SKIPPED = 5  # steps in a row without a finite gradient that end the fit
MOMENTS = ("exp_avg", "exp_avg_sq")  # Adam's state of each parameter
_REVISION = 1  # of the fit; results of an earlier revision are not used

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
    """Hash of all that the edits are fitted from; arguments as for `fit_edits`."""
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
    """Fit the edits that make the scene look like the pictures. Gaussians that none of their views shows are not changed.

    Args:
        scene: the frozen scene.
        pictures: indices of views and their edited pictures, uint8 in the size of the cameras.
        steps: number of steps. Each uses one view, and all views are used once before any is used again.
        seed: of the order of the views.
        device: device of the fit.
        side: pixels of the longer side to which the pictures are shrunk; None: CPU_SIDE on a CPU, no shrinking with CUDA.
        progress: show a bar.
        resume: file of the unfinished fit, written every STORE_EVERY steps and removed at the end. An interrupted fit resumes
            from it and ends with the same bits (on a CPU with the same number of threads).

    Returns:
        The edits on the CPU.

    Raises:
        ValueError: there are no pictures, one belongs to no view or is not uint8 in the size of the cameras, no Gaussian is
            seen in them, or `steps` or `side` is too small.
        FloatingPointError: several steps in a row gave no finite gradient.
    """
    _check(scene, pictures, steps, side)
    device = torch.device(device)
    key = edits_key(scene, pictures, steps=steps, seed=seed, device=device, side=side)
    side = CPU_SIDE if side is None and device.type == "cpu" else side
    gaussians = scene.gaussians.detach().to(device)
    with _bar(progress) as bar:
        looking = bar.add_task("looking at the views", total=len(pictures), loss="")
        views = EditedViews.of(gaussians, scene.cameras, pictures, side, lambda: bar.advance(looking))
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
        with suppress(OSError):  # the file may never have been stored, or its disk may be gone
            resume.unlink()
    return fit.edits(len(gaussians)).to("cpu")


def _check(scene: Scene, pictures: Sequence[Picture], steps: int, side: int | None) -> None:
    if not pictures:
        raise ValueError("edits are fitted to at least one edited picture, found none")
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
    """The view of a step: all views in a random order, then all in another. It depends on seed and step only, so that a resumed
    fit needs no state."""
    generator = torch.Generator().manual_seed(seed + 1_000_003 * (step // count))
    return int(torch.randperm(count, generator=generator)[step % count])


class _Fit:
    """The optimization: the edits of the Gaussians that are seen, and the state of Adam."""

    def __init__(self, gaussians: Gaussians, views: EditedViews) -> None:
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
        """Take one step.

        Args:
            view: index of the edited view.
            rate: factor of the learning rates.

        Returns:
            The loss of the view before the step.
        """
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
        """Whether the gradient is finite; steps with another gradient are counted.

        Raises:
            FloatingPointError: the gradient was not finite in several steps in a row.
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
        # The colour without its dependence on the direction stays within 0..1, or no further outside than it was.
        constant = SH_C0 * self.scene.colors[:, 0] + 0.5
        self.change["rgb"].clamp_(-constant.clamp_min(0), (1 - constant).clamp_min(0))
        for name, bound in BOUNDS.items():
            self.change[name].clamp_(-bound, bound)

    def edits(self, count: int) -> Edits:
        """The edits of all `count` Gaussians of the scene; they are zero for Gaussians that are not seen."""
        found = {}
        for name, tensor in self.change.items():
            found[name] = tensor.new_zeros(count, *tensor.shape[1:])
            found[name][self.ids] = tensor.detach()
        return Edits(**found)

    def store(self, path: Path, key: str) -> bool:
        """Store the state of the fit for `restore`.

        Args:
            path: file of the state.
            key: the `edits_key` of the fit.

        Returns:
            False if the file could not be written.
        """
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
        """Resume from a stored state if it has the same key; arguments as for `store`."""
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
    """`view_colors` with a gradient below black too. A tenth of the Gaussians of a capture are darker than black from some
    side, and they must whiten like the others."""
    center = torch.linalg.inv(viewmat.double())[:3, 3].to(gaussians.means)
    basis = sh_basis(gaussians.sh_degree or 0, torch.nn.functional.normalize(gaussians.means - center, dim=1))
    colors = torch.einsum("nk,nkc->nc", basis, gaussians.colors) + 0.5
    return colors + (colors.clamp_min(0) - colors).detach()


def difference(shown: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """Mean absolute difference of two pictures mixed with their structural dissimilarity; 0 for equal pictures."""
    from torchmetrics.functional.image import structural_similarity_index_measure as similarity  # takes seconds to import

    ours, theirs = (picture.permute(2, 0, 1)[None] for picture in (shown, target))
    alike = similarity(ours, theirs, data_range=1.0)
    assert isinstance(alike, Tensor)
    return (1 - SIMILARITY) * (shown - target).abs().mean() + SIMILARITY * (1 - alike)


def _bar(show: bool) -> Progress:
    counts = BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[loss]}"), TimeElapsedColumn(), TimeRemainingColumn()
    return Progress(TextColumn("{task.description}"), *counts, console=console, disable=not show, transient=True)

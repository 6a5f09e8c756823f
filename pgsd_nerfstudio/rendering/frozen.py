"""Views of a frozen scene: what can be prepared for one camera, kept as long as there is room.

Projecting, sorting and binning a large scene costs more than blending a small image of it. The scene never changes, so this is
done once for each camera. The saving is exact: no picture differs by a bit. If the scene is also pressed into layers
(layers.py), a frame costs hardly more than its dynamic Gaussians, at a small error.

What a camera and a moment see once, such as a frame of a video, is projected, sorted and binned only, and blended together with
what moves. The scene is blended alone when the same view is asked for again.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from pgsd_nerfstudio.rendering.binning import Binned, bin_splats, keep_entries, visible_by_depth
from pgsd_nerfstudio.rendering.blending import blend_frozen
from pgsd_nerfstudio.rendering.harmonics import color
from pgsd_nerfstudio.rendering.layers import Layers, press
from pgsd_nerfstudio.rendering.moment import Moment, Viewpoint
from pgsd_nerfstudio.rendering.projection import BLUE, COLUMNS, RED, Lens, lens, project
from pgsd_nerfstudio.rendering.rasterizer import RasterConfig
from pgsd_nerfstudio.rendering.view_cache import ViewCache
from pgsd_nerfstudio.scene.gaussians import Gaussians


class View(NamedTuple):
    """One camera as the kernels need it."""

    viewmat: np.ndarray
    """[4, 4] float64, world to camera."""
    lens: Lens


class FrozenView(NamedTuple):
    """A frozen scene prepared for one camera."""

    part: Binned | Layers
    """The frozen splats or layers that dynamic splats are merged with."""
    image: np.ndarray | None
    """[5, h, w] float32 as in blending.py: the frozen scene alone, without background; None before it is blended alone."""

    @property
    def nbytes(self) -> int:
        return self.part.nbytes + (0 if self.image is None else self.image.nbytes)


def float_array(tensor: torch.Tensor) -> np.ndarray:
    """A contiguous float32 array for the kernels; it shares memory with the tensor if it can."""
    return np.ascontiguousarray(tensor.detach().to(torch.float32).numpy())


def motions_array(gaussians: Gaussians) -> np.ndarray:
    """Displacements [n, 3] for the kernels, [0, 3] if there are none."""
    moved = gaussians.displacements
    return np.zeros((0, 3), np.float32) if moved is None else float_array(moved)


Shade = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]
"""From colours [m, 3], means [m, 3] and indices [m] of Gaussians to the colours that arrive at the camera."""


def splat(gaussians: Gaussians, view: View, shade: Shade | None = None) -> tuple[Binned, np.ndarray]:
    """Project, sort and bin Gaussians.

    Args:
        gaussians: on the CPU.
        view: the camera.
        shade: changes the colours on their way to the camera; None leaves them.

    Returns:
        The splats with their tile lists, and the index [m] int32 of the Gaussian of each splat.
    """
    splats = np.empty((len(gaussians), COLUMNS), np.float32)
    project(
        float_array(gaussians.means),
        float_array(gaussians.quats),
        float_array(gaussians.scales),
        float_array(gaussians.opacities),
        motions_array(gaussians),
        gaussians.antialiased,
        gaussians.whole,
        view.viewmat,
        view.lens,
        splats,
    )
    color(float_array(gaussians.colors), float_array(gaussians.means), view.viewmat, splats)
    ids = visible_by_depth(splats)
    visible = np.take(splats, ids, axis=0)  # several times faster than an index of rows
    if shade is not None:
        seen = torch.from_numpy(ids).long()
        unshaded = torch.from_numpy(np.ascontiguousarray(visible[:, RED : BLUE + 1]))
        visible[:, RED : BLUE + 1] = shade(unshaded, gaussians.means.detach()[seen], seen).numpy()
    return bin_splats(visible, view.lens.width, view.lens.height), ids


class FrozenViews:
    """Prepared views of a frozen scene, one for each camera; the least recently used are dropped when memory runs out."""

    def __init__(self, gaussians: Gaussians, config: RasterConfig, cache_bytes: int, layers: int | None = None) -> None:
        self._gaussians = gaussians
        self._config = config
        self._layers = layers
        self._cache: ViewCache[FrozenView] = ViewCache(cache_bytes)

    @property
    def nbytes(self) -> int:
        """Bytes that the views hold now."""
        return self._cache.nbytes

    def __len__(self) -> int:
        return len(self._cache)

    def __str__(self) -> str:
        return f"{self._cache} ({'exact' if self._layers is None else f'{self._layers} layers'})"

    def get(
        self,
        viewmat: torch.Tensor,
        K: torch.Tensor,
        width: int,
        height: int,
        moment: Moment | None = None,
        *,
        once: bool = False,
    ) -> tuple[View, FrozenView]:
        """The view of one camera at a moment, prepared if it is not kept.

        Args:
            viewmat: [4, 4], world to camera.
            K: [3, 3] intrinsics in pixels.
            width: of the image in pixels.
            height: of the image in pixels.
            moment: how the weather changes the frozen scene; None leaves it.
            once: whether an exact view that is asked for the first time may come without its image.
        """
        intrinsics = K.detach().cpu().double().numpy()
        pose = np.ascontiguousarray(viewmat.detach().cpu().double().numpy())
        view = View(pose, lens(intrinsics, width, height, self._config))

        def again(kept: FrozenView) -> FrozenView:
            return kept if isinstance(kept.part, Layers) or kept.image is not None else self._blended(kept.part, view)

        def prepared(gaussians: Gaussians, shade: Shade | None = None) -> FrozenView:
            binned, _ = splat(gaussians, view, shade)
            return FrozenView(binned, None) if once and self._layers is None else self._blended(binned, view)

        if moment is None:
            return view, self._cache.get(viewmat, K, width, height, lambda: prepared(self._gaussians), again=again)
        seen_from = Viewpoint(viewmat.detach().cpu().float(), K.detach().cpu().float(), width, height)

        def make() -> FrozenView:
            def shade(rgb: torch.Tensor, means: torch.Tensor, ids: torch.Tensor) -> torch.Tensor:
                return moment.frozen_colors(rgb, means, ids, seen_from)

            return prepared(moment.altered(self._gaussians), shade)

        return view, self._cache.get(viewmat, K, width, height, make, moment.key, again)

    def _blended(self, binned: Binned, view: View) -> FrozenView:
        width, height = view.lens.width, view.lens.height
        needed = np.zeros(len(binned.entries), bool)
        image = np.empty((5, height, width), np.float32)
        limits = np.float32(self._config.max_alpha), np.float32(self._config.min_transmittance)
        blend_frozen(binned, width, height, *limits, image, needed)
        part = keep_entries(binned, needed)
        return FrozenView(part if self._layers is None else press(part, width, height, *limits, self._layers), image)

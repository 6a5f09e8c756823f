"""The views of a scene as a dataset of nerfstudio: the photograph of each where there is one, else a render of the scene."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, UInt8
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.data.scene_box import SceneBox
from PIL import Image
from torch import Tensor

from pgsd_nerfstudio.plugin.moments import marked_as_views
from pgsd_nerfstudio.plugin.run_cameras import from_nerfstudio, to_nerfstudio
from pgsd_nerfstudio.scene.captures.photographs import Seen, read_photograph
from pgsd_nerfstudio.storage import atomic_write, cache_dir
from pgsd_nerfstudio.weather.prepared_scene import PreparedScene

BACKGROUND = (0.149, 0.1647, 0.2157)  # behind the splat: what nerfstudio shows behind splatfacto's


class Views(InputDataset):
    """Some of the training views, with times spread over the whole weather.

    A view without a photograph is rendered when it is first asked for, and kept as a picture in the cache.
    """

    def __init__(self, prepared: PreparedScene, indices: list[int], smaller: float = 1.0) -> None:
        """Views of a scene.

        Args:
            prepared: the scene.
            indices: numbers of the views.
            smaller: factor by which the pictures are smaller than those of the scene's cameras.
        """
        self.prepared, self.indices = prepared, indices
        super().__init__(view_outputs(prepared, indices, smaller))

    def get_numpy_image(self, image_idx: int) -> UInt8[np.ndarray, "h w 3"]:
        """The picture in the size of its camera: the photograph, or the frozen scene."""
        seen = self.photograph(image_idx, torch.tensor(BACKGROUND))
        if seen is not None:
            # Beyond the edges of the photograph there is nothing, as behind the splat.
            shown = torch.where(seen.known[..., None], seen.rgb, torch.tensor(BACKGROUND))
            return (shown * 255 + 0.5).byte().numpy()
        path = self.image_filenames[image_idx]
        size = int(self.cameras.width[image_idx]), int(self.cameras.height[image_idx])
        if not path.is_file():
            picture = Image.fromarray(self._render(self.indices[image_idx]))
            with atomic_write(path) as beside:
                picture.save(beside)
        else:
            picture = Image.open(path)
        return np.asarray(picture if picture.size == size else picture.resize(size, Image.Resampling.LANCZOS))

    def photograph(self, image_idx: int, background: Float[Tensor, "3"]) -> Seen | None:
        """What the photograph of a view shows of it, in the size of its camera; None where it is missing.

        Args:
            image_idx: number of the view in this dataset.
            background: colour behind a photograph that is transparent.

        Raises:
            SceneError: the photograph cannot be read.
        """
        index, photographs = self.indices[image_idx], self.prepared.scene.photographs
        if not photographs or not photographs[index].there:
            return None
        return read_photograph(photographs[index], from_nerfstudio(self.cameras[image_idx : image_idx + 1]), background)

    def _render(self, index: int) -> UInt8[np.ndarray, "h w 3"]:
        with torch.no_grad():
            rgb = self.prepared.rasterizer.render(self.prepared.scene.cameras[index].to(self.prepared.device)).rgb[0]
        return (rgb.clamp(0, 1) * 255 + 0.5).byte().cpu().numpy()


def view_outputs(prepared: PreparedScene, indices: list[int], smaller: float = 1.0) -> DataparserOutputs:
    """What a dataparser would say of these views; scene units are the run's coordinates, so its transform is the identity."""
    scene = prepared.scene
    folder, there = cache_dir() / "views" / scene.content_key(), set(scene.photographed())
    names = [scene.images[i] if i in there else folder / f"view_{i:04d}.png" for i in indices]
    centers = scene.cameras.centers
    cameras = scene.cameras[torch.tensor(indices)].resized(
        max(1, round(scene.cameras.width / smaller)), max(1, round(scene.cameras.height / smaller))
    )
    return DataparserOutputs(
        image_filenames=names,
        cameras=marked_as_views(to_nerfstudio(cameras, torch.linspace(0.0, 1.0, len(indices)))),
        scene_box=SceneBox(aabb=torch.stack([centers.amin(0), centers.amax(0)])),
    )

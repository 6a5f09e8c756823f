"""Photographs of a capture: found on disk as nerfstudio finds them, and read as a pinhole camera would have taken them."""

from __future__ import annotations

import struct
import warnings
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.captures.lenses import Lens
from pgsd_nerfstudio.scene.errors import SceneError

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
"""Kinds of pictures, in the order in which they are tried for a name without its suffix."""
DOWNSCALED = (2, 4, 8)
"""Folders such as images_2 hold the same photographs with a half, a quarter and an eighth of the pixels per side."""
SIXTEEN = 65535.0  # white in 16 bits
UNREADABLE = (
    OSError,
    ValueError,
    SyntaxError,
    TypeError,
    LookupError,
    ArithmeticError,
    EOFError,
    MemoryError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
)
"""What PIL raises on damaged pictures."""


@dataclass(frozen=True)
class Photograph:
    """A photograph on disk, which may be missing, and the lens that took it."""

    path: Path
    lens: Lens
    mask: Path | None = None
    """A picture that is black where the photograph was not trained on."""

    @property
    def there(self) -> bool:
        """Whether the file is on disk."""
        return is_there(self.path)


@dataclass(frozen=True)
class Seen:
    """What a photograph shows of a pinhole camera's image."""

    rgb: Float[Tensor, "h w 3"]
    """0..1."""
    known: Bool[Tensor, "h w"]
    """Whether the photograph shows this pixel: not beyond its edge, and not masked out."""
    opacity: Float[Tensor, "h w"]
    """0..1; below 1 the background shows through."""


def find_photographs(names: Sequence[str], folders: Sequence[Path]) -> list[Path]:
    """Where photographs lie, for names as files of cameras give them.

    nerfstudio's dataparsers take a name as it is, with .png added (instant-ngp, Blender), and from images_2, images_4 and so
    on. Beyond these, names with backslashes, with another suffix, and absolute ones whose folder has moved are found.

    Args:
        names: one for each photograph.
        folders: where they may lie, the likeliest first.

    Returns:
        One path for each name; where there is no such file, the path in the first folder.
    """
    listed: dict[Path, dict[str, list[Path]]] = {}
    return [_found(_portable(name), folders, listed) for name in names]


def _found(name: PurePosixPath, folders: Sequence[Path], listed: dict[Path, dict[str, list[Path]]]) -> Path:
    parts = name.parts[1:] if name.is_absolute() else name.parts
    tails = [PurePosixPath(*parts[k:]) for k in range(len(parts))] if name.is_absolute() else [name]
    here = [Path(name)] if name.is_absolute() else []
    for place in (*here, *(folder / tail for tail in tails for folder in folders)):
        if (path := _as_named(place, listed)) is not None:
            return path
    for factor in DOWNSCALED:
        for place in (folder / tail for tail in tails for folder in folders):
            beside = place.parent.with_name(f"{place.parent.name}_{factor}") if place.parent.name else place.parent
            for smaller in (beside / place.name, *(folder / f"images_{factor}" / place.name for folder in folders)):
                if (path := _as_named(smaller, listed)) is not None:
                    return path
    return folders[0] / (tails[0] if not name.is_absolute() else name.name)


def _portable(name: str) -> PurePosixPath:
    """A name with slashes; absolute if it is so on any system."""
    posix = PurePosixPath(name.replace("\\", "/"))
    windows = PureWindowsPath(name)
    return PurePosixPath("/", *windows.parts[1:]) if windows.drive else posix


def _as_named(place: Path, listed: dict[Path, dict[str, list[Path]]]) -> Path | None:
    """The file of this name, or one that differs in its suffix only."""
    if place.suffix.lower() in SUFFIXES and is_there(place):
        return place
    folder = place.parent
    if folder not in listed:
        listed[folder] = {}
        try:
            inside = sorted(folder.iterdir())
        except (OSError, ValueError):  # no such folder, or one that may not be listed
            inside = []
        for path in inside:
            if path.suffix.lower() in SUFFIXES:
                listed[folder].setdefault(path.stem, []).append(path)
    stem = place.stem if place.suffix.lower() in SUFFIXES else place.name
    return min(listed[folder].get(stem, ()), key=lambda path: SUFFIXES.index(path.suffix.lower()), default=None)


def is_there(path: Path) -> bool:
    """Whether there is such a file; names that no file can have name none."""
    try:
        return path.is_file()
    except OSError:
        return False


def read_photograph(
    photograph: Photograph, camera: Cameras, background: tuple[float, float, float] | Float[Tensor, "3"] = (0.0, 0.0, 0.0)
) -> Seen:
    """A photograph as the pinhole camera would have taken it, in the camera's size.

    What is transparent in the photograph shows the background, as splatfacto composites it in training. A photograph of another
    aspect than its lens counts as its middle part, and is never stretched.

    Args:
        photograph: the file and its lens.
        camera: the one view in any image size.
        background: RGB in 0..1.

    Raises:
        SceneError: the file cannot be read.
    """
    u, v = torch.meshgrid(torch.arange(camera.width) + 0.5, torch.arange(camera.height) + 0.5, indexing="xy")
    K, lens = camera.Ks[0].double().cpu(), photograph.lens
    at, drawn = lens.pixels(torch.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]], dim=-1))
    # Pixels of the lens's own image in a pixel of the camera: how far the stored picture may be shrunk before it is sampled.
    coarse = min(lens.fx / float(K[0, 0]), lens.fy / float(K[1, 1]))
    picture = _opened(photograph.path, lens, coarse)
    rgb, alpha = picture.planes[:3], picture.planes[3:]
    behind = torch.as_tensor(background, dtype=torch.float32).cpu()[:, None, None]
    composited = torch.cat([rgb * alpha + behind * (1 - alpha), alpha])
    sampled, inside = _sampled(replace(picture, planes=composited), at, lens)
    known = drawn & inside
    if photograph.mask is not None and is_there(photograph.mask):
        mask = _opened(photograph.mask, lens, coarse)
        trained_on, inside = _sampled(replace(mask, planes=(mask.planes[:3].amax(0, keepdim=True) > 0).float()), at, lens)
        known &= inside & (trained_on[0] > 0.5)
    return Seen(sampled[:3].permute(1, 2, 0).contiguous(), known, sampled[3])


@dataclass(frozen=True)
class _Stored:
    """A picture as read from disk, perhaps shrunk."""

    planes: Float[Tensor, "c h w"]
    size: tuple[int, int]
    """Width and height of the file in pixels."""
    pitch: float
    """Pixels of the file in a pixel of the planes; the last ones of a row or column may reach over the edge."""


def _opened(path: Path, lens: Lens, coarse: float) -> _Stored:
    """RGB and opacity in 0..1, shrunk as far as pixels that are `coarse` times those of the lens allow."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # PIL doubts large pictures and odd tags, and reads them all the same
            with Image.open(path) as stored:
                size = stored.size
                shrink = max(1, int(coarse * max(size[0] / lens.width, size[1] / lens.height)))
                smaller = stored.draft("RGB", (-(-size[0] // shrink), -(-size[1] // shrink)))  # JPEG decodes what that needs
                pitch = 1 if smaller is None else round(size[0] / smaller[1][2])
                factor = max(1, shrink // pitch)
                return _Stored(_pixels(stored, factor), size, pitch * factor)
    except UNREADABLE as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SceneError(f"the picture {path} cannot be read ({reason}): copy it again, or write it as .png or .jpg") from error


def _pixels(stored: Image.Image, factor: int) -> Float[Tensor, "4 h w"]:
    """RGB and opacity in 0..1 of a picture of any kind: means over squares of factor x factor pixels."""
    if stored.mode.startswith("I") or stored.mode == "F":
        # 16 bits of grey; PIL's conversion to RGB would cut them off at 255.
        grey = np.array(stored).astype(np.float32)
        most = SIXTEEN if stored.mode.startswith("I") else 1.0
        if not np.isfinite(grey).all() or grey.max(initial=0.0) > most or grey.min(initial=0.0) < 0:
            raise ValueError(f"its greys reach from {grey.min():g} to {grey.max():g}, expected 0 to {most:g}")
        plane = torch.from_numpy(grey / most)[None, None]
        plane = torch.nn.functional.avg_pool2d(plane, factor, ceil_mode=True, count_include_pad=False)[0, 0]
        return torch.stack([plane, plane, plane, torch.ones_like(plane)])
    transparent = "A" in stored.getbands() or "a" in stored.getbands() or "transparency" in stored.info
    small = stored.convert("RGBA" if transparent else "RGB").reduce(factor)
    planes = torch.from_numpy(np.array(small)).permute(2, 0, 1).float() / 255
    return planes if transparent else torch.cat([planes, torch.ones_like(planes[:1])])


def _sampled(
    picture: _Stored, at: Float[Tensor, "h2 w2 2"], lens: Lens
) -> tuple[Float[Tensor, "c h2 w2"], Bool[Tensor, "h2 w2"]]:
    """The picture, bilinear, at pixels of the lens, and which of these it shows."""
    stored = torch.tensor(picture.size, dtype=at.dtype)
    image = torch.tensor([lens.width, lens.height], dtype=at.dtype)
    zoom = stored / image
    if ((zoom.flip(0) * image - stored).abs() > 1).all():  # another aspect, and by more than whole pixels make of the same
        zoom = zoom.amax().expand(2)
    place = (at - image / 2) * zoom + stored / 2
    inside = ((place >= 0) & (place <= stored)).all(-1)
    # grid_sample's -1 and 1 are the outer edges of the planes.
    covered = picture.pitch * torch.tensor([picture.planes.shape[2], picture.planes.shape[1]], dtype=at.dtype)
    grid = (2 * place / covered - 1).nan_to_num(2.0)[None].to(picture.planes)
    found = torch.nn.functional.grid_sample(picture.planes[None], grid, padding_mode="border", align_corners=False)
    return found[0], inside

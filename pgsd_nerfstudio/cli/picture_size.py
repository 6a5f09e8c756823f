"""The size of the pictures of a video: what was asked for, in the shape of the cameras where only one side was."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pgsd_nerfstudio.refusal import Refusal

if TYPE_CHECKING:
    from pgsd_nerfstudio.scene.cameras import Cameras

LEAST, MOST = 16, 8192  # pixels of a side: what H.264 and memory bear


def check_size(width: int | None, height: int | None) -> None:
    """Refuse sides that no video has.

    Raises:
        Refusal: a side is too short or too long.
    """
    for name, value in (("width", width), ("height", height)):
        if value is not None and not LEAST <= value <= MOST:
            raise Refusal(f"--{name} must lie in {LEAST}-{MOST}, got {value}")


def even_size(cameras: Cameras, width: int | None, height: int | None, longest: int = MOST) -> tuple[int, int]:
    """Even sides in pixels, as videos want them.

    Args:
        cameras: whose shape the pictures have where at most one side is given.
        width: as asked for.
        height: as asked for.
        longest: most pixels of a side where none is given.
    """
    if width is None and height is None:
        shrink = min(1.0, longest / max(cameras.width, cameras.height))
        width, height = round(cameras.width * shrink), round(cameras.height * shrink)
    elif width is None:
        width = round((height or 0) * cameras.width / cameras.height)
    elif height is None:
        height = round(width * cameras.height / cameras.width)
    return max(2, width // 2 * 2), max(2, (height or 0) // 2 * 2)

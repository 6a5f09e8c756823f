"""Silence about what only the developers of nerfstudio 1.1.5 can change: the deprecations of torch that its imports meet.

torch calls `hush` at the end of its own import, by the entry point in the group torch.backends: every command imports torch
before nerfstudio, and nerfstudio before this plugin, so that anything later would come too late. It runs in every process
that imports torch where this package is installed, and is therefore cheap and silences nothing but the messages named here.
"""

from __future__ import annotations

import logging
import sys
import warnings

DEPRECATED = (
    r"`torch\.jit\.script` is deprecated",
    r"`torch\.cuda\.amp\.(custom_fwd|custom_bwd|GradScaler)\(args\.\.\.\)` is deprecated",
)
"""Beginnings of warnings on import, and when a trainer is made."""
CONVERTED = "Converting a tensor with requires_grad=True to a scalar"
"""Of nerfstudio's writer, for the loss of every step."""


def hush() -> None:
    """Ignore these warnings, unless warnings were asked for (`python -W`, PYTHONWARNINGS)."""
    if sys.warnoptions:
        return
    for message in DEPRECATED:
        warnings.filterwarnings("ignore", message=message, category=FutureWarning)
    warnings.filterwarnings("ignore", message=CONVERTED, category=UserWarning, module=r"nerfstudio\.")
    # torch says that it cannot count operations of triton, which is left out where there is no GPU.
    logging.getLogger("torch.utils.flop_counter").setLevel(logging.ERROR)

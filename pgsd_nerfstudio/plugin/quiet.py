"""Silence about what only the developers of nerfstudio 1.1.5 can change: the deprecations of torch that its imports meet.

torch calls `hush` at the end of its own import, by the entry point in the group torch.backends: every command of nerfstudio
imports torch before nerfstudio, and nerfstudio before this plugin, so that anything later would come too late. Any other
process that imports torch where this package is installed calls it too; there it does nothing.
"""

from __future__ import annotations

import logging
import sys
import warnings
from pathlib import Path

COMMANDS = ("ns-", "pgsd")
"""Beginnings of the names of the programs that are silenced."""
DEPRECATED = (
    r"`torch\.jit\.script` is deprecated",
    r"`torch\.cuda\.amp\.(custom_fwd|custom_bwd|GradScaler)\(args\.\.\.\)` is deprecated",
)
"""Beginnings of warnings on import, and when a trainer is made."""
CONVERTED = "Converting a tensor with requires_grad=True to a scalar"
"""Of nerfstudio's writer, for the loss of every step."""


def hush() -> None:
    """Ignore these warnings in nerfstudio's and our own commands, unless they were asked for (`python -W`, PYTHONWARNINGS)."""
    if sys.warnoptions or not Path(next(iter(sys.argv), "")).name.startswith(COMMANDS):
        return
    for message in DEPRECATED:
        warnings.filterwarnings("ignore", message=message, category=FutureWarning)
    warnings.filterwarnings("ignore", message=CONVERTED, category=UserWarning, module=r"nerfstudio\.")
    # torch says that it cannot count operations of triton, which is left out where there is no GPU.
    logging.getLogger("torch.utils.flop_counter").setLevel(logging.ERROR)

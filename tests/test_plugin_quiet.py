"""Commands are silent about what their users cannot change; other programs are left alone."""

from __future__ import annotations

import subprocess
import sys
import warnings

import pytest

from pgsd_nerfstudio.plugin.quiet import hush

SPOKEN = "`torch.jit.script` is deprecated. Please switch"


@pytest.mark.parametrize(
    ("program", "options", "silent"),
    [("/venv/bin/ns-train", [], True), ("pgsd", [], True), ("mine.py", [], False), ("ns-train", ["default"], False)],
)
def test_only_commands_are_silenced_and_only_if_nobody_asked(program, options, silent, monkeypatch):
    monkeypatch.setattr(sys, "argv", [program])
    monkeypatch.setattr(sys, "warnoptions", options)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        hush()
        warnings.warn(SPOKEN, FutureWarning, stacklevel=1)
        warnings.warn("something else is deprecated", FutureWarning, stacklevel=1)
    assert [SPOKEN in str(each.message) for each in heard] == ([False] if silent else [True, False])


def test_torch_calls_it_at_the_end_of_its_import():
    code = (
        "import sys; sys.argv = ['ns-train']; import torch, warnings; print([f[1].pattern for f in warnings.filters if f[1]])"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert "custom_fwd" in said.stdout

#!/usr/bin/env bash
# torch 2.15.0: torch.load does not compare the checksums that torch.save writes: a file with a flipped bit is read as good.
#
# Guess before the run: a file of torch.save is a ZIP archive with a CRC-32 of each tensor, so that a changed one is noticed.
# Seen: of 200 files with one bit flipped somewhere, nearly all load without a word, as another tensor. Python's own
# zipfile.ZipFile(path).testzip() names the changed part.
#
# Needs python3 (3.10-3.12), the network, and about 5 GB in $TMPDIR. Exits non-zero if the behaviour changes.
set -euo pipefail
made="$(mktemp -d)"
trap 'rm -rf "$made"' EXIT
"${PYTHON:-python3}" -m venv "$made/venv"
"$made/venv/bin/pip" -q install uv==0.13.9
VIRTUAL_ENV="$made/venv" "$made/venv/bin/uv" pip install -q torch==2.15.0 numpy==1.26.4
cd "$made"
"$made/venv/bin/python" - <<'PYTHON_END'
import io
import random
import zipfile

import torch

buffer = io.BytesIO()
weights = torch.arange(20_000, dtype=torch.float32)
torch.save({"weights": weights}, buffer)
whole, draw = buffer.getvalue(), random.Random(0)
silent = noticed = 0
for _ in range(200):
    changed = bytearray(whole)
    changed[draw.randrange(len(changed))] ^= 1 << draw.randrange(8)
    try:
        loaded = torch.load(io.BytesIO(changed), weights_only=True)["weights"]
    except Exception:
        continue
    if not torch.equal(loaded, weights):
        silent += 1
        noticed += zipfile.ZipFile(io.BytesIO(changed)).testzip() is not None
version = torch.__version__.partition("+")[0]
print(f"torch {version}: of 200 files with one flipped bit, {silent} load as other tensors; zipfile notices {noticed} of these")
assert silent > 180 and noticed == silent, "the behaviour has changed"
PYTHON_END

#!/usr/bin/env bash
# torch 2.15.0: a class that add_safe_globals has allowed is no longer allowed after a `with safe_globals([the same class])` ends.
#
# Guess before the run: the context restores what was allowed before it.
# Seen: it removes everything that it names, also what was allowed before it was entered; torch.load(weights_only=True) of a file
# that loaded a moment ago raises UnpicklingError. It matters where a library reads its own files inside of such a context: the
# program around it loses what it had allowed for itself.
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
from pickle import UnpicklingError

import torch


class Note:
    pass


def loads(data: bytes) -> bool:
    try:
        torch.load(io.BytesIO(data), weights_only=True)
    except UnpicklingError:
        return False
    return True


buffer = io.BytesIO()
torch.save(Note(), buffer)
data = buffer.getvalue()
torch.serialization.add_safe_globals([Note])
before = loads(data)
with torch.serialization.safe_globals([Note]):
    within = loads(data)
after = loads(data)
print(f"torch {torch.__version__.partition('+')[0]}: loads before the context {before}, within {within}, after {after}")
assert (before, within, after) == (True, True, False), "the behaviour has changed"
PYTHON_END

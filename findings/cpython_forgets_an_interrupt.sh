#!/usr/bin/env bash
# CPython 3.10.13, 3.11.2, 3.11.7, 3.12.1, 3.13.0: a program that Ctrl-C ends exits with 1, and not by the signal (130 in a
# shell), if its sys.excepthook executes a string, as importing dataclasses or numpy for the first time does.
#
# Guess before the run: what sys.excepthook does to show an error has no influence on the exit code; an uncaught
# KeyboardInterrupt ends the process by SIGINT (bpo-1054041, Python 3.8), so that shell scripts that called it stop too.
# Seen: exec() within the hook clears the interpreter's note of the interruption, and the process ends with 1: a calling script
# takes it for an ordinary failure. A hook has to import what it needs before it is called.
#
# Needs python3 (3.10-3.13) alone. Exits non-zero if the behaviour changes.
set -euo pipefail
python="${PYTHON:-python3}"
ended_with() {
    local status=0
    "$python" -c "import sys; sys.excepthook = lambda *_: $1; raise KeyboardInterrupt" || status=$?
    echo "$status"
}
silent="$(ended_with None)" executing="$(ended_with 'exec("pass")')" importing="$(ended_with '__import__("dataclasses")')"
echo "$("$python" --version): a hook that does nothing: $silent; that executes a string: $executing; that imports dataclasses: $importing"
[ "$silent $executing $importing" = "130 1 1" ] || { echo "the behaviour has changed" >&2; exit 1; }

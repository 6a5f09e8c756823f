"""Laws of `pgsd bench` and `pgsd verify`: the record format, the exit codes, and that nothing fails silently."""

import json
import sys
from types import ModuleType

import numpy as np
import pytest

from pgsd_nerfstudio.cli.main import run
from pgsd_nerfstudio.laboratory import rooms
from pgsd_nerfstudio.laboratory.records import Record, meets, print_records, read_records, split_source, stamped, write_records

KEYS = ["name", "value", "unit", "error", "error_unit", "target", "holds", "source"]
GOOD = Record.judged("fall", 1.0, "m/s", "<= 2", error=1e-3, error_unit="relative", source="exact")
BAD = Record.judged("drift", 3.0, "m", "<= 2", source="exact")


@pytest.fixture
def house(monkeypatch):
    """A house whose rooms are given as functions: house(physics={"bench": f})."""

    def build(**given):
        monkeypatch.setattr(rooms, "ROOMS", tuple(given))
        monkeypatch.setattr(rooms, "find_spec", lambda name: name.rpartition(".")[2] in given or None)
        for room, functions in given.items():
            module = ModuleType(rooms.module_of(room))
            vars(module).update(functions)
            monkeypatch.setitem(sys.modules, module.__name__, module)

    return build


@pytest.mark.parametrize(
    ("value", "target", "expected"),
    [
        (0.5, "<= 0.5", True),
        (0.51, "<= 0.5", False),
        (1, "> 1", False),
        (1, "< 1", False),
        (2, ">= 1e-3", True),
        (3, "==3", True),
        (-1, "< -0.5", True),
    ],
)
def test_a_target_is_a_comparison_with_one_number(value, target, expected):
    assert meets(value, target) is expected


@pytest.mark.parametrize("target", ["", "0.5", "<= about 3", "<= 1, >= 0", "=< 3"])
def test_an_unreadable_target_is_refused(target):
    with pytest.raises(ValueError, match="a target reads like"):
        Record("x", 1.0, "m", target=target, holds=True)


def test_the_json_is_a_list_of_records_with_exactly_their_keys(tmp_path):
    write_records(
        tmp_path / "new" / "rows.json", [GOOD, Record("gpu", None, "ms", target="<= 5", source="no CUDA device here")]
    )
    stored = json.loads((tmp_path / "new" / "rows.json").read_text())
    assert isinstance(stored, list)
    assert [list(row) for row in stored] == [KEYS, KEYS]
    assert stored[0]["holds"] is True
    assert stored[1]["holds"] is None and stored[1]["value"] is None
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["rows.json"]


def test_records_survive_writing_and_reading(tmp_path):
    write_records(tmp_path / "rows.json", [GOOD, BAD])
    assert read_records(tmp_path / "rows.json") == [GOOD, BAD]


@pytest.mark.parametrize("text", ['[{"name": "x", "value": 1, "unit": "m"}]', '{"name": "x"}', "[1]", "no JSON"])
def test_another_json_is_not_read_as_records(tmp_path, text):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(ValueError, match="does not hold records"):
        read_records(tmp_path / "x.json")


@pytest.mark.mistyped
def test_numpy_scalars_become_plain_json_numbers():
    record = Record("x", np.float32(1.5), "m", error=np.float64(0.1), holds=np.bool_(True))
    assert type(record.value) is float and type(record.error) is float and record.holds is True


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_a_figure_is_finite(number):
    with pytest.raises(ValueError, match="must be finite"):
        Record("x", number, "m")


@pytest.mark.parametrize("row", [{"value": None}, {"value": 1.0, "target": "<= 2"}])
def test_what_is_not_measured_or_not_judged_says_why(row):
    with pytest.raises(ValueError, match="must say why"):
        Record("x", unit="ms", **row)
    assert Record("x", unit="ms", source="needs a GPU", **row).holds is None


def test_a_stamp_keeps_the_rows_own_source():
    (row,) = stamped([GOOD], "pgsd bench physics on x86")
    assert split_source(row.source) == ("exact", "pgsd bench physics on x86")


def test_the_table_gives_the_reason_for_what_does_not_hold():
    from rich.console import Console

    console = Console(record=True, width=120, file=open("/dev/null", "w"))  # noqa: SIM115, PTH123
    print_records("room", [GOOD, Record.judged("drift", 3.0, "m", "<= 2", source="the floor leaks")], console)
    text = console.export_text()
    assert "1e-03" in text or "0.001 relative" in text
    assert "holds" in text and "fails" in text and "the floor leaks" in text


@pytest.mark.parametrize(("rows", "strict", "code"), [([GOOD], True, 0), ([GOOD, BAD], True, 2), ([GOOD, BAD], False, 0)])
def test_strict_turns_a_row_that_does_not_hold_into_exit_code_2(house, rows, strict, code):
    house(physics={"verify": lambda quick: rows})
    assert run(["verify", *(["--strict"] if strict else [])]) == code


def test_quick_reaches_the_room_and_the_command_reaches_the_json(house, tmp_path, capsys):
    seen = []
    house(physics={"bench": lambda quick: seen.append(quick) or [GOOD]}, surface={"bench": lambda quick: 1 / 0})
    assert run(["bench", "physics", "--quick", "--json", str(tmp_path / "rows.json")]) == 0
    assert seen == [True]
    assert capsys.readouterr().out.startswith("pgsd bench physics --quick\n")
    (row,) = read_records(tmp_path / "rows.json")
    assert split_source(row.source)[1].startswith("pgsd bench physics --quick on ")


def test_a_room_that_crashes_is_a_row_and_exit_code_1_and_the_others_still_run(house, tmp_path, capsys):
    house(scene={"bench": lambda quick: 1 / 0}, physics={"bench": lambda quick: [GOOD]}, surface={"verify": lambda quick: []})
    assert run(["bench", "--strict", "--json", str(tmp_path / "rows.json")]) == 1
    crash, good = read_records(tmp_path / "rows.json")
    assert crash.holds is False and "ZeroDivisionError" in crash.source
    assert good.holds is True
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["bench", "kitchen"], '"kitchen" offers no figures; expected one of: physics'),
        (["bench", "physics"], '"physics" has nothing to bench; try pgsd verify physics'),
        (["bench"], "no room offers anything to bench yet"),
        (["verify", "--json", "/proc/none/rows.json"], "could not write /proc/none/rows.json"),
    ],
)
def test_what_cannot_be_run_gets_one_sentence_and_exit_code_1(house, capsys, arguments, sentence):
    house(physics={"verify": lambda quick: [GOOD]})
    assert run(arguments) == 1
    error = capsys.readouterr().err.strip()
    assert sentence in error and len(error.splitlines()) == 1


def test_every_room_with_rows_offers_bench_or_verify():
    import importlib

    for room in rooms.rooms_with_rows():
        module = importlib.import_module(rooms.module_of(room))
        assert hasattr(module, "bench") or hasattr(module, "verify"), room

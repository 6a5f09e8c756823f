"""The rows of what is in the air: all are judged or say why not, and all hold."""

from __future__ import annotations

from pgsd_nerfstudio.laboratory.rows import air_cases as rows_air_cases
from pgsd_nerfstudio.laboratory.rows.air_cases import GUNN_KINZER_1949, cases, costs


def test_every_case_holds_or_says_why_it_is_not_judged():
    rows = {row.name: row for row in cases(quick=True)}
    assert sum(name.startswith("rain of") and "against" in name for name in rows) == len(GUNN_KINZER_1949)
    unjudged = [row for row in rows.values() if row.holds is None]
    assert [row.name for row in unjudged] == ["drizzle of 0.1 and 0.2 mm against Gunn & Kinzer, worse"]
    assert "not judged" in unjudged[0].source
    assert [row.name for row in rows.values() if row.holds is False] == []


def test_a_wrong_fall_speed_fails_its_rows(monkeypatch):
    monkeypatch.setattr(rows_air_cases, "rain_fall_speed", lambda diameter: 9.65 - 10.3 * 0.9 ** (1e3 * diameter))
    failed = [row.name for row in cases(quick=True) if row.holds is False]
    assert len([name for name in failed if name.startswith("rain of")]) >= 5


def test_costs_stand_beside_errors():
    rows = costs(quick=True)
    speeds = [row for row in rows if row.name.startswith("airborne")]
    assert len(speeds) == 4 and all(row.error is not None and row.error < 20 for row in speeds)  # mm after a second
    assert all(row.value is not None and row.value > 0.2 for row in speeds)
    assert [row.name for row in rows if row.holds is False] == []
    timed = [row for row in rows if row.unit in {"s", "ms", "ns"}]
    assert len(timed) == 3 and all(row.error is not None for row in timed)

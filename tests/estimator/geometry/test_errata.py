"""Errata of docs/paper.md: each number from the published tables or from exact rays, and as printed on the page."""

from __future__ import annotations

import json
import math
import re
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np
import pytest
from helpers.oracles import alhazen_quartic, paper_cases

from phibench.estimator.geometry.paper_depth import error_eq6, error_eq7, load_published

R, SPHERE_M, LENS_M = 0.06, 0.71, 0.26
PAGE = (Path(__file__).parents[3] / "docs/paper.md").read_text(encoding="utf-8")

PRINTED_M = {
    "table1": (0.2, 0.19, 0.14, 0.1, 0.05, 0.01, -0.05),
    "table2": (-0.18, -0.27, -0.03, -0.01, -0.08, -0.18, -0.1),
    "table3": (0.58, 0.38, -0.23, 0.08, -0.06, -0.15, -0.28),
    "table4": (0.08, 0.08, 0.014, 0.06),
}
PRINTED_PERCENT = {
    "table1": (9.17, 8.72, 6.42, 4.59, 2.29, 0.46, 2.29),
    "table2": (5.66, 8.49, 0.94, 0.31, 2.52, 5.66, 3.14),
    "table3": (13.88, 9.09, 5.50, 1.91, 1.44, 3.59, 6.70),
}
"""Rows "Depth error" of the paper, as printed."""


def erratum(*words: str) -> str:
    """The one row of the errata whose first cells have the words."""
    errata = PAGE.split("## Errata")[1].split("\n## ")[0]
    (row,) = (line for line in errata.split("\n") if all(word in line for word in words) and line.startswith("|"))
    return row


def angles(spot: np.ndarray, offset_m: float) -> float:
    """2 phi_ray by the roots of Alhazen's quartic."""
    centre = np.array([0.0, 0.0, SPHERE_M + offset_m])
    mirror = alhazen_quartic(np.array([0.0, 0.0, -LENS_M]), spot - centre, R)
    to_spot = spot - centre - mirror
    return math.atan2(math.hypot(to_spot[0], to_spot[1]), -to_spot[2])


def exact_error(spot: np.ndarray, stroke_m: float) -> float:
    """Root of the sum of the squares of dD/d(2 phi_k), metres per radian, by differences of the rays' crossing.

    The reflection point moves with the angle as a point of the sphere does: its normal turns by half the ray's angle
    (camera at infinity) to first order in the mirror's size, which is 2 % of D.
    """
    theta = np.array([angles(spot, 0.0), angles(spot, stroke_m)])
    step = 1e-6
    slopes = [
        (crossing(theta + step * e, stroke_m) - crossing(theta - step * e, stroke_m)) / (2.0 * step) for e in np.eye(2)
    ]
    return math.hypot(*slopes)


def crossing(theta: np.ndarray, stroke_m: float) -> float:
    """Distance at which the rays of both positions cross, leaving the sphere where its normal has half their angle."""
    (x1, z1), (x2, z2) = ((R * math.sin(t / 2), -R * math.cos(t / 2)) for t in theta)
    A = np.array([[math.sin(theta[0]), -math.sin(theta[1])], [-math.cos(theta[0]), math.cos(theta[1])]])
    length = np.linalg.solve(A, [x2 - x1, z2 + stroke_m - z1])[0]
    return float(x1 + length * math.sin(theta[0]))


def test_printed_errors_of_tables_1_to_3_have_signs_and_those_of_table_4_and_the_percentages_have_none() -> None:
    rows = {name: list(group) for name, group in groupby(load_published(), lambda row: row.experiment)}
    signed = {name: [row.error_m for row in group] for name, group in rows.items()}
    for name in ("table1", "table2", "table3"):
        # printed to 0.01 m
        assert signed[name] == pytest.approx(PRINTED_M[name], abs=1e-9)
        relative = [100.0 * abs(row.error_m) / row.real_depth_m for row in rows[name]]
        assert relative == pytest.approx(PRINTED_PERCENT[name], abs=0.0051)
        assert min(signed[name]) < 0.0 < min(PRINTED_PERCENT[name])
    assert np.abs(signed["table4"]) == pytest.approx(PRINTED_M["table4"], abs=1e-9)
    shown = ", ".join(f"{value:+.3f}".rstrip("0") for value in signed["table4"])
    assert shown == "-0.08, +0.08, +0.014, -0.06"
    assert shown in erratum("Table 4", "without signs")


def test_lambda_and_epsilon_over_what_they_are_said_to_be_far_below() -> None:
    of_stroke, of_depth = [], []
    for row, spot in paper_cases():
        h, (one, two) = row.baseline_m, (angles(spot, x) for x in (0.0, row.baseline_m))
        t1, t2 = math.tan(one), math.tan(two)
        of_stroke.append(100.0 * R * (math.cos(two / 2) - math.cos(one / 2)) / h)
        epsilon = R * (t2 * math.sin(one / 2) - t1 * math.sin(two / 2)) / (t2 - t1)
        of_depth.append(100.0 * epsilon / row.real_depth_m)
    assert len(of_stroke) == 25
    assert f"{min(of_stroke):.2f} to {max(of_stroke):.2f} % of h" in erratum("lambda")
    assert f"{min(of_depth):.2f} to {max(of_depth):.2f} % of D" in erratum("epsilon")


def test_eq7_holds_in_all_experiments_and_does_not_make_errors_rise() -> None:
    """The derivative by equal, independent errors of both angles; eq. (7) takes their disparity's, sqrt(2) larger."""
    ratios, of_six, table1 = [], [], []
    for row, spot in paper_cases():
        phi = [angles(spot, x) / 2.0 for x in (0.0, row.baseline_m)]
        seven = float(error_eq7(row.real_depth_m, *phi, row.baseline_m))
        exact = exact_error(spot, row.baseline_m)
        ratios.append(exact / (math.sqrt(2.0) * seven))
        of_six.append(float(error_eq6(row.real_depth_m, *phi, row.baseline_m)) / seven)
        if row.experiment == "table1":
            table1.append((row.baseline_m, exact, ratios[-1]))
    strokes, errors, of_seven = (np.array(column) for column in zip(*table1, strict=True))
    text = erratum("Section 6", "h << D")
    assert f"{min(ratios):.3f} to {max(ratios):.3f}" in text
    assert strokes[np.argmax(of_seven)] == 1.40
    assert max(ratios) == of_seven.max()
    assert np.all(np.diff(errors) < 0.0)  # still falls at the longest stroke
    assert f"{errors[-2]:.2f} to {errors[-1]:.2f} m/rad" in text
    assert f"{min(of_six):.2f} to {max(of_six):.2f}" in erratum("eq. (7)", "h << D")


def test_best_strokes_of_the_paper_shrink_where_eq7_asks_for_the_longest() -> None:
    study = json.loads((Path(__file__).parents[3] / "docs/studies/stroke.json").read_text(encoding="utf-8"))
    found = {row["label"]: row["value"] for row in study["findings"]}
    text, best, longest, ours = erratum("best strokes"), [], [], []
    for name in ("table1", "table2", "table3"):
        rows = [row for row in load_published() if row.experiment == name]
        best.append(min(rows, key=lambda row: abs(row.error_m)).baseline_m)
        longest.append(max(row.baseline_m for row in rows))
        ours.append(found[f"as built, D = {rows[0].real_depth_m:g} m: best stroke"])
    assert best == sorted(best, reverse=True)
    assert ours == sorted(ours)
    assert "1.30, 0.425, 0.35 m" in text
    assert best == [1.30, 0.425, 0.35]
    assert ", ".join(f"{h:.2f}" for h in longest) in text
    assert ", ".join(f"{h:.2f}" for h in ours) in text


def test_published_errors_are_no_law_of_one_over_h() -> None:
    """Section 6 calls it verified: |error| = c / h leaves more than a straight line with a change of sign does."""
    rows = [row for row in load_published() if row.experiment == "table1"]
    h, error = np.array([row.baseline_m for row in rows]), np.array([row.error_m for row in rows])

    def residual(columns: list[np.ndarray], values: np.ndarray) -> float:
        A = np.stack(columns, axis=-1)
        rest = values - A @ np.linalg.lstsq(A, values)[0]
        return float(np.sqrt(rest @ rest / (len(values) - A.shape[1])))

    line, law = residual([np.ones_like(h), h], error), residual([1.0 / h], error)
    assert (f"{line:.3f} m", f"{law:.3f} m") == tuple(re.findall(r"\d\.\d{3} m", erratum("verified")))
    signs = {name: [row.error_m > 0.0 for row in load_published() if row.experiment == name]
             for name in ("table1", "table2", "table3")}  # fmt: skip
    changes = [sum(a != b for a, b in pairwise(s)) for s in signs.values()]
    assert changes == [1, 0, 3]


def test_the_concordance_has_a_row_for_every_figure_table_and_equation_and_a_page_for_each() -> None:
    section = PAGE.split("## Concordance")[1].split("\n## ")[0]
    rows = [line.strip("| ").split(" | ") for line in section.split("\n") if line.startswith("|")][2:]
    assert {len(row) for row in rows} == {5}
    places = [row[0] for row in rows]
    assert numbered(places, r"Figs?\. (\d+)(?: to (\d+))?") == set(range(1, 12))
    assert numbered(places, r"Tables? (\d+)(?: to (\d+))?") == {1, 2, 3, 4}
    assert numbered(places, r"[Ee]qs?\. \((\d+)\)(?: to \((\d+)\))?") == set(range(1, 8))
    assert {place.split(":")[0].split(".")[0] for place in places} >= {"Abstract", *"124567", "open"}
    # what has a command has a result and a page
    assert [row for row in rows if row[2] != "-" and ("-" in (row[3], row[4]) or "](" not in row[4])] == []


def numbered(places: list[str], pattern: str) -> set[int]:
    """Numbers that places name, ranges spelt out."""
    found = (match for place in places for match in re.finditer(pattern, place))
    return {n for match in found for n in range(int(match[1]), int(match[2] or match[1]) + 1)}

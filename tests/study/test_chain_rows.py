"""What the study of the chain says and draws of planted rows, without a bench."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from hilstar.basics import charts
from hilstar.instruments.study.chain import answers, measuring, run
from hilstar.instruments.study.chain import glass as chain_glass
from hilstar.instruments.study.chain.glass import draw_glass
from hilstar.instruments.study.chain.measuring import CombinationRow, ErrorPart, StageTime
from hilstar.instruments.study.chain.run import beating, front
from hilstar.instruments.study.sweep import Load
from tests.support.figures import assert_legible

ROW = CombinationRow(
    scene="average field",
    rate_deg_s=0.0,
    exposure_s=0.1,
    bits=8,
    bit_stealing="false",
    faintest_v_mag=7.5,
    sprite="cut",
    sprite_px="9",
    smear="path",
    prediction="rate",
    quantisation="exact",
    stars=30,
    lost=0,
    error_arcsec=1.0,
    error_mag=0.01,
    attitude_arcsec=0.3,
    roll_arcsec=4.0,
    time_ms=5.0,
    iqr_ms=0.2,
    noise_ms=0.01,
    cpu_ms=5.0,
    frames=20,
)
AUTO = replace(ROW, chosen="auto")


def row(**changes: object) -> CombinationRow:
    return replace(ROW, **changes)


def test_rows_are_the_fastest_first_with_three_fronts():
    rows = run.rows_of(
        [
            AUTO,
            row(quantisation="round", time_ms=2.0, error_arcsec=3.0, error_mag=0.009),
            row(quantisation="dither", time_ms=6.0, error_arcsec=1.5),
            row(bit_stealing="true", time_ms=4.0, error_arcsec=0.9, error_mag=0.02),
        ]
    )
    assert [each.time_ms for each in rows] == [2.0, 4.0, 5.0, 6.0]
    assert [each.on_front for each in rows] == ["true", "true", "false", "false"]
    # by light the first is the best of all
    assert [each.on_front_mag for each in rows] == ["true", "false", "false", "false"]
    # bit stealing is not effort's choice: without it auto is on its front
    assert [each.on_front_as_filed for each in rows] == ["true", "false", "true", "false"]
    bare = run.without_fronts(rows[0])
    assert (bare.on_front, bare.on_front_mag, bare.on_front_as_filed) == ("", "", "")


STOLEN = {"time_ms": 3.0, "error_arcsec": 0.5, "bit_stealing": "true"}
BY_STEALING = (
    "not on the front: exact with bit stealing, cut sprites is 0.5 arcsec off and 2 ms faster"
    " (noise 0.014 ms): bit stealing is the bench file's choice, for a panel whose primaries are"
    " known as the tracker sees them"
)


@pytest.mark.parametrize(
    ("rivals", "words"),
    [
        ([{"time_ms": 9.0, "error_arcsec": 0.5}], "on the front"),
        (
            [{"time_ms": 4.98, "noise_ms": 0.0}],
            "on the front within the noise: exact, cut sprites is 1 arcsec off and 0.02 ms faster"
            " (noise 0.01 ms)",
        ),
        (
            [{"time_ms": 3.0, "quantisation": "round"}],
            "not on the front: round, cut sprites is 1 arcsec off and 2 ms faster (noise 0.014 ms):"
            " effort compares exact and round by their worst star at any sub-pixel phase, not by a"
            " field's rms",
        ),
        # the nearest of those that beat it is named
        (
            [STOLEN, {**STOLEN, "time_ms": 1.0, "error_arcsec": 0.9}],
            f"{BY_STEALING}; on the front of what effort may choose",
        ),
        (
            [STOLEN, {"time_ms": 4.99, "error_arcsec": 0.75}],
            f"{BY_STEALING}; on the front of what effort may choose, within the noise",
        ),
        (
            [STOLEN, {"time_ms": 4.0, "error_arcsec": 0.95, "sprite": "full"}],
            f"{BY_STEALING}; nor of what effort may choose: exact, full sprites is 0.95 arcsec off"
            " and 1 ms faster (noise 0.014 ms): cut sprites save nothing here",
        ),
    ],
)
def test_where_auto_stands_is_said_with_what_beats_it(rivals, words):
    assert run.standing([AUTO, *(row(**rival) for rival in rivals)]) == words


def test_why_auto_does_not_take_a_row_is_each_choice_that_differs():
    own = replace(AUTO, rate_deg_s=1.0)
    assert run.words(own) == "exact, cut sprites, paths, rate"
    for changes, words in (
        ({"quantisation": "temporal"}, "temporal is right over an exposure"),
        ({"quantisation": "round"}, "effort compares exact and round by their worst star"),
        ({"bit_stealing": "true"}, "bit stealing is the bench file's choice"),
        ({"sprite": "coarse"}, "coarse sprites are beyond the tolerance"),
        ({"sprite": "full"}, "cut sprites save nothing here"),
        ({"smear": "point"}, "points instead of paths"),
        ({"prediction": "two samples"}, "prediction by two samples is the sender's choice"),
        ({"faintest_v_mag": 6.5}, "the catalogue's depth is the bench file's choice"),
    ):
        reason = run.why_not(own, replace(own, **changes))
        assert reason.startswith(words) and ";" not in reason
    held = replace(own, prediction="held")
    assert (
        run.why_not(held, own) == "[attitude] max_extrapolation_ms = 0 is the bench file's choice"
    )
    both = run.why_not(own, replace(own, smear="point", sprite="coarse"))
    assert both == "coarse sprites are beyond the tolerance; points instead of paths"
    coarse = replace(own, sprite="coarse")
    assert run.why_not(coarse, coarse) == ""


BUDGET = [
    ErrorPart("average field", "auto", "refresh", 0.2, 0.03),
    ErrorPart("average field", "auto", "codes", 0.7, 0.01),
    ErrorPart("average field", "auto", "rss", 0.73, 0.032),
    ErrorPart("average field", "auto", "whole", 0.75, 0.033),
    ErrorPart("1 deg/s", "auto", "refresh", math.nan, 0.03),
    ErrorPart("1 deg/s", "auto", "codes", 0.7, 0.01),
    ErrorPart("1 deg/s", "auto", "whole", 9.0, 0.01),
]
STAGES = [
    StageTime("average field", "auto", "prediction", 1.0),
    StageTime("average field", "auto", "drawing and codes", 3.0),
]


def test_a_scene_s_line_has_its_figures_and_the_largest_part_of_each():
    line = run.scene_line([replace(AUTO, lost=2)], BUDGET[:4], STAGES, Load())
    assert line == (
        "average field: auto (exact, cut sprites) is 1 arcsec and 0.01 mag off over 30 stars, 2 of"
        " them lost, in 5 ms; on the front; error: codes 0.7 arcsec; time: drawing and codes 75%"
    )
    finding = run.budget_finding(["average field", "1 deg/s"], BUDGET, STAGES, Load())
    # what is not known counts as the largest
    assert finding == (
        "Of auto's error most is quantisation in the average field, panel's refresh at 1 deg/s; of"
        " its time most is drawing and codes"
    )


def test_tables_and_charts_of_scenes_are_of_their_rows(tmp_path, figures):
    scene = run.rows_of(
        [
            AUTO,
            row(quantisation="round", time_ms=2.0, error_arcsec=3.0, chosen="default"),
            row(quantisation="exact", faintest_v_mag=6.5, time_ms=4.0, error_arcsec=9.0, lost=3),
        ]
    )
    result = run.SceneResult(scene, BUDGET[:4], STAGES)
    lines = run.write_chain(tmp_path, [result], [], ["of nothing"], Load())
    chain, budget = figures
    (axes,) = chain.axes
    assert axes.get_title(loc="left") == "Average field, 30 stars"
    points = {tuple(line.get_xydata()[0]) for line in axes.get_lines() if line.get_marker() == "o"}
    assert points == {(2.0, 3.0), (4.0, 9.0), (5.0, 1.0)}
    rings = {}
    for line in axes.get_lines():
        if line.get_marker() == "o" and line.get_markerfacecolor() == "none":
            rings[line.get_markeredgecolor()] = tuple(line.get_xydata()[0])
    assert rings == {charts.RED: (5.0, 1.0), charts.INK: (2.0, 3.0)}
    place, light, times = budget.axes
    bars = [[bar.get_width() for bar in of.patches] for of in (place, light, times)]
    assert bars == [[0.2, 0.7, 0.75], [0.03, 0.01, 0.033], [1.0, 3.0]]
    colours = [bar.get_facecolor() for bar in place.patches]
    assert colours[0] == colours[1] != colours[2]  # the whole of it
    assert lines[0].startswith('at rest on 8 bits: set quantisation = "exact", 1 arcsec')
    assert lines[1].startswith("bit stealing: not on this panel")
    assert lines[-1] == (
        "depth: keep faintest_v_mag = 7.5; with 6.5 the tracker loses 3 of 30 stars"
    )


def test_a_shallower_catalogue_is_judged_by_its_best_row():
    rows = [ROW, row(faintest_v_mag=6.5, error_arcsec=2.0, lost=4)]
    rows.append(row(faintest_v_mag=6.5, error_arcsec=1.5))
    assert answers.depth_line(rows) == (
        "depth: faintest_v_mag = 6.5 is enough; it loses none of 30 stars"
    )
    assert answers.depth_line([ROW]) == "depth: faintest_v_mag = 7.5 was measured alone"


def test_bit_stealing_is_worth_what_it_takes_off_the_error():
    plain = row(quantisation="round", error_arcsec=1.0, time_ms=4.0)
    stealing = row(bit_stealing="true", error_arcsec=0.5, time_ms=6.0)
    worse = row(bit_stealing="true", error_arcsec=0.95, error_mag=0.001, time_ms=6.0)
    assert answers.stealing_line([plain, stealing, worse], plain, Load()) == (
        "bit stealing, if the primaries are known in the tracker's colours: takes"
        f" {charts.two_digits(1.0)} arcsec to {charts.two_digits(0.5)} in 1.50 of the time, with"
        " exact"
    )
    assert "brings nothing at rest" in answers.stealing_line([plain, worse], plain, Load())
    busy = Load(1e3)
    assert "of the time" not in answers.stealing_line([plain, stealing], plain, busy)
    assert answers.rest_lines([plain, row(error_arcsec=0.2)], Load())[0].startswith(
        'at rest on 8 bits: set quantisation = "exact", 0.2 arcsec (round: 1 in 0.80 of the time)'
    )


def test_answers_are_whole_choices_of_what_the_sender_gives():
    """Neither coarse nor full sprites, nor points; rates are used where they come, and only there."""
    turning = row(rate_deg_s=1.0)
    rows = [
        turning,
        replace(turning, prediction="two samples"),
        replace(turning, prediction="held"),
    ]
    rows += [replace(turning, sprite="coarse"), replace(turning, sprite="full")]
    rows += [replace(turning, smear="point"), replace(turning, faintest_v_mag=6.5)]
    rows.append(replace(turning, quantisation="temporal"))
    by_given = {}
    for rates in (True, False):
        chosen = answers.allowed(rows, answers.Given(primaries=True, rates=rates))
        assert {(each.sprite, each.smear, each.quantisation) for each in chosen} == {
            ("cut", "path", "exact")
        }
        by_given[rates] = [each.prediction for each in chosen]
    assert by_given == {True: ["rate"], False: ["two samples", "held"]}


def test_an_answer_s_light_is_held_against_rows_that_are_as_near():
    """A row far off in place is no measure of light."""
    near = row(quantisation="round", error_arcsec=1.0, error_mag=0.02)
    far = row(error_arcsec=9.0, error_mag=0.001)
    assert answers.simplest([near, far]) is near


def test_a_prediction_s_error_is_that_of_its_best_codes():
    rows = []
    for prediction, quantisation, arcsec in (
        *(("rate", "round", 3.0), ("rate", "exact", 2.0), ("rate", "temporal", 0.1)),
        *(("two samples", "exact", 1.0), ("two samples", "round", 1.5), ("held", "exact", 70.0)),
    ):
        changes = {"prediction": prediction, "quantisation": quantisation}
        rows.append(row(rate_deg_s=1.0, error_arcsec=arcsec, **changes))
    rows.append(row(prediction="held", faintest_v_mag=6.5, error_arcsec=0.1))
    rows.append(row(prediction="held", bit_stealing="true", error_arcsec=0.1))
    assert answers.prediction_words(rows) == (
        "send no rates, which carry such a vibration on (by the packets' rates 2, by two samples 1,"
        " the newest attitude held 70 arcsec)"
    )


def test_the_title_says_in_how_many_scenes_auto_is_on_the_front():
    beaten = row(scene="1 deg/s", time_ms=1.0, error_arcsec=0.1)
    rows = [AUTO, replace(AUTO, scene="dense field"), replace(AUTO, scene="1 deg/s"), beaten]
    title = run.headline(rows, Load())
    assert title.endswith("or within its noise, in 2 of 3 scenes, not in 1 deg/s")
    assert run.headline(rows[:3], Load()).endswith("in 3 of 3 scenes")
    assert "2 of 3" not in run.headline(rows, Load(1e3))


def test_points_are_named_on_the_front_where_they_are_a_tenth_better_and_once_a_code_beside_it():
    rows = [
        row(quantisation="round", error_arcsec=9.0, on_front="true"),
        row(quantisation="round", error_arcsec=8.2, on_front="true", faintest_v_mag=6.5),
        row(quantisation="exact", error_arcsec=8.0, on_front="true", bit_stealing="true"),
        row(quantisation="dither", error_arcsec=30.0, rate_deg_s=1.0, smear="point"),
        row(quantisation="dither", error_arcsec=20.0, rate_deg_s=1.0, prediction="held"),
        replace(AUTO, error_arcsec=1.0, time_ms=12.0, on_front="true"),
        row(quantisation="temporal", error_arcsec=40.0, chosen="default"),
    ]
    at = [(each.time_ms, each.error_arcsec) for each in rows]
    assert [(name, place[1], colour) for name, place, colour in run.side_names(rows, at)] == [
        ("round", 9.0, charts.PURPLE),
        ("exact + bit stealing", 8.0, charts.BLUE),
        ("auto: 1 arcsec, 12 ms", 1.0, charts.RED),
        ("default: 40 arcsec, 5 ms", 40.0, charts.INK),
        ("dither, paths held", 20.0, charts.ORANGE),
        ("temporal", 40.0, charts.GREEN),
    ]
    assert run.short_words(rows[3], AUTO) == "dither, points by rate"
    assert run.short_words(rows[1], AUTO) == "round, fewer stars"


def test_an_error_of_nothing_stands_far_below_the_smallest(tmp_path, figures):
    """On a logarithmic axis: a thousandth of it."""
    rows = [AUTO, row(error_arcsec=0.0, time_ms=9.0)]
    run.draw(tmp_path / "c", rows, "A finding", "a machine", [])
    drawn = set()
    for line in figures[0].axes[0].get_lines():
        drawn.update(line.get_ydata())
    assert min(drawn) == pytest.approx(1e-3) and max(drawn) == 1.0


def test_a_busy_machine_s_tables_have_no_front_and_no_verdict(small_run):
    beaten = [AUTO, row(time_ms=1.0, error_arcsec=0.1)]
    result = run.SceneResult(run.rows_of(beaten), BUDGET[:4], STAGES)
    assert run.verdict([result], Load()) is False
    assert run.verdict([result], Load(1e3)) is None
    columns = ("on_front", "on_front_mag", "on_front_as_filed")
    busy = small_run(run.write_chain, [result], [], ["of nothing"], Load(1e3))
    assert [[row[name] for name in columns] for row in busy.rows("chain")] == 2 * [["", "", ""]]
    glass = [glass_row("a Gaussian", 2.0, 1.0), glass_row("a basis of 6", 0.5, 9.0)]
    idle = small_run(run.write_chain, [result], glass, ["of nothing"], Load())
    psfs = [(row["psf"], row["error_arcsec"]) for row in idle.rows("chain_psf")]
    assert psfs == [("a Gaussian", "2.0"), ("a basis of 6", "0.5")]
    assert {row["on_front"] for row in idle.rows("chain")} == {"true", "false"}


def test_steps_that_change_nothing_are_named_and_not_drawn(tmp_path, figures):
    """One that changes light alone is drawn."""
    scene = "average field"
    budget = [
        ErrorPart(scene, "auto", "depth", 0.0, 0.03),
        ErrorPart(scene, "auto", "smear", 0.0, 0.0),
        ErrorPart(scene, "auto", "codes", 0.7, 0.01),
        ErrorPart(scene, "auto", "prediction", 0.0, 0.0),
        ErrorPart(scene, "auto", "whole", 0.75, 0.033),
    ]
    turning = replace(AUTO, scene="1 deg/s", rate_deg_s=1.0)
    more = [replace(part, scene="1 deg/s", error_arcsec=2 * part.error_arcsec) for part in budget]
    stages = [*STAGES, StageTime("1 deg/s", "auto", "sprites", 7.0)]
    run.draw_budget(tmp_path / "b", [AUTO, turning], [*budget, *more], stages, Load())
    place, light, times, turning_place, _, turning_times = figures[0].axes
    # each scene's own parts and stages
    assert [bar.get_width() for bar in turning_place.patches] == [0.0, 1.4, 1.5]
    assert [bar.get_width() for bar in times.patches] == [1.0, 3.0]
    assert [bar.get_width() for bar in turning_times.patches] == [7.0]
    assert [bar.get_width() for bar in place.patches] == [0.0, 0.7, 0.75]
    assert [bar.get_width() for bar in light.patches] == [0.03, 0.01, 0.033]
    note = " ".join(figures[0].get_supxlabel().split())
    assert note.endswith("; smear and prediction change nothing here.")


@pytest.mark.parametrize(
    ("rival", "right"),
    [
        ({"time_ms": 5.0, "error_arcsec": 9.0}, True),  # faster, and less right
        ({"time_ms": 4.97, "error_arcsec": 1.0}, True),  # within three sigmas of both medians
        ({"time_ms": 4.9, "error_arcsec": 1.0}, False),
        (
            {"time_ms": 1.0, "error_arcsec": 1.0, "bit_stealing": "true"},
            True,
        ),  # not effort's choice
    ],
)
def test_auto_is_right_where_no_choice_of_its_own_is_better_beyond_the_noise(rival, right):
    """Each median has a noise of 0.01 ms: three sigmas of their difference are 0.042 ms."""
    auto = row(chosen="auto", time_ms=5.0, error_arcsec=2.0)
    alone = [auto, row(time_ms=6.0, error_arcsec=3.0)]
    assert run.is_right([alone])
    assert run.is_right([alone, [auto, row(**rival)]]) is right


@pytest.mark.parametrize("place", [(0, 0), (-1, 0), (0, -1), (-1, -1)])
def test_the_chart_names_its_front_and_what_is_chosen(figures, tmp_path, place):
    """The slowest or fastest point, the worst or best of them, is the default, and the one
    beside it auto.
    """
    time_ms, error = sorted((1.0, 9.0))[place[0]], sorted((0.1, 900.0))[place[1]]
    rows = [
        row(time_ms=t, error_arcsec=e, on_front="true")
        for t in (1.0, 3.0, 9.0)
        for e in (0.1, 10.0, 900.0)
    ]
    rows += [
        row(time_ms=time_ms * k, error_arcsec=error, chosen=name, on_front="true")
        for name, k in (("default", 1), ("auto", 1.01))
    ]
    run.draw(tmp_path / "c", rows, "A finding", "a machine", [])
    (figure,) = figures
    assert_legible(figure)
    names = [text.get_text() for text in figure.axes[0].texts]
    for name, k in (("default", 1), ("auto", 1.01)):
        assert (
            f"{name}: {charts.two_digits(error)} arcsec, {charts.two_digits(time_ms * k)} ms"
            in names
        )
    assert "exact" in names and "dither" not in " ".join(names)


def test_a_busy_machine_s_chart_has_no_front(figures, tmp_path):
    rows = [
        run.without_fronts(row(time_ms=t, error_arcsec=10 / t, chosen=name))
        for t, name in ((1.0, "auto"), (3.0, ""))
    ]
    run.draw(tmp_path / "c", rows, "A finding", "a machine", [])
    (figure,) = figures
    assert_legible(figure)
    assert "front" not in figure.get_supxlabel()


def test_scenes_that_are_alike_are_drawn_once():
    rates = {
        "average field": (0.0, 0.23),
        "dense field": (0.0, 0.24),
        "faint field": (0.0, 0.9),
        "1 deg/s": (1.0, 0.25),
    }
    rows = [
        row(scene=name, rate_deg_s=rate, error_arcsec=error, chosen="auto")
        for name, (rate, error) in rates.items()
    ]
    assert run.differing(rows) == {
        "average field": ["dense field"],
        "faint field": [],
        "1 deg/s": [],
    }


def test_a_point_is_beaten_by_one_that_is_no_worse_and_no_slower():
    spots = [(1.0, 3.0), (2.0, 2.0), (2.0, 2.0), (2.0, 2.5), (3.0, 1.0), (3.5, 1.0)]
    assert front([row(time_ms=t, error_mag=e) for t, e in spots], "error_mag") == [
        True,
        True,
        True,
        False,
        True,
        False,
    ]

    def beaters(which, *points):
        rows = [row(time_ms=t, error_arcsec=e, noise_ms=n) for t, e, n in points]
        rows[which] = replace(rows[which], chosen="auto")
        return tuple([rows.index(row) for row in found] for found in beating(rows))

    near = (1.00, 1.0, 0.01), (1.02, 1.0, 0.01), (1.5, 1.0, 0.01)
    assert beaters(1, *near) == ([], [0])
    assert beaters(2, *near) == ([0, 1], [])
    assert beaters(0, (1.02, 1.0, 0.01), (1.0, 0.1, 0.01)) == ([], [1])
    assert beaters(0, (1.02, 1.0, 0.0), (1.02, 0.1, 0.0)) == ([1], [])


def answered(given: answers.Given, rate_deg_s: float = 0.0, **errors: float) -> CombinationRow:
    """The answer among planted rows: the error of each, arcsec, by codes, then `s` for bit
    stealing and `t` for two samples.
    """
    rows = []
    for name, arcsec in errors.items():
        codes, _, flags = name.partition("_")
        rows.append(
            row(
                error_arcsec=arcsec,
                error_mag=0.001,
                quantisation=codes,
                bit_stealing="true" if "s" in flags else "false",
                prediction="two samples" if "t" in flags else "rate",
                rate_deg_s=rate_deg_s,
            )
        )
    return answers.simplest(answers.allowed(rows, given))


def test_an_answer_is_the_simplest_that_is_near_the_best_of_what_is_given():
    bare, known = answers.Given(False, True), answers.Given(True, True)
    assert answered(bare, round=1.0, exact=0.2, exact_s=0.1).quantisation == "exact"
    assert answered(bare, round=1.05, exact=1.0).quantisation == "round"
    assert answered(bare, round=1.0, exact=0.2, exact_s=0.1).bit_stealing == "false"
    assert answered(known, round=1.0, exact=0.2, exact_s=0.1).bit_stealing == "true"
    assert answered(known, exact=0.105, exact_s=0.1).bit_stealing == "false"
    assert answered(bare, temporal=0.01, dither=0.05, exact=0.2).quantisation == "exact"
    turning = {"exact": 1.2, "exact_t": 0.7}
    assert answered(answers.Given(False, True), 1.0, **turning).prediction == "rate"
    assert answered(answers.Given(False, False), 1.0, **turning).prediction == "two samples"


def test_a_cheaper_choice_whose_light_is_far_worse_is_no_answer():
    rows = [
        row(quantisation="round", bit_stealing="false", error_arcsec=1.0, error_mag=0.02),
        row(quantisation="exact", bit_stealing="false", error_arcsec=1.0, error_mag=0.002),
    ]
    assert answers.simplest(rows).quantisation == "exact"


def test_each_turn_is_named_from_which_another_step_is_most_of_the_error():
    rows, budget = [], []
    for scene, rate, largest in (
        ("s", 0.0, "codes"),
        ("a", 1.0, "prediction"),
        ("b", 3.0, "prediction"),
        ("c", 10.0, "refresh"),
    ):
        for prediction, arcsec in (("rate", 1.0), ("two samples", 2.0)):
            errors = {"error_arcsec": arcsec, "bit_stealing": "false"}
            rows.append(row(scene=scene, rate_deg_s=rate, prediction=prediction, **errors))
        steps = {
            step: 2.0 if step == largest else 0.5 for step in ("codes", "prediction", "refresh")
        }
        budget += [
            measuring.ErrorPart(scene, "auto", step, size, 0.0)
            for step, size in {**steps, "rss": 3.0, "whole": 2.5}.items()
        ]
    lines = answers.turn_lines(answers.scenes_of(rows)[1:], budget)
    assert [line.split(" is ")[0] for line in lines] == [
        "from 1 deg/s on prediction",
        "from 10 deg/s on the panel's refresh",
    ]
    assert (
        "2 of 2.5 arcsec): send rates (by the packets' rates 1, by two samples 2 arcsec)"
        in lines[0]
    )


def glass_row(psf, error_arcsec, time_ms, **figures):
    known = {field.name: 1.0 for field in fields(chain_glass.GlassRow)}
    words = {"scene": "dense field", "stars": 30, "on_front": "false", "chosen": ""}
    known |= words | {"psf": psf, "error_arcsec": error_arcsec, "time_ms": time_ms}
    return chain_glass.GlassRow(**(known | figures))


def test_the_psfs_of_a_glass_are_told_and_drawn_by_their_error_and_time():
    rows = [
        glass_row("a Gaussian", 12.0, 2.0, error_percent=3.0, noise_ms=0.5),
        glass_row("a basis of 6", 0.125, 9.0, error_percent=0.4, chosen="auto", on_front="true"),
        glass_row("the whole", 0.0, 40.0, error_percent=0.2, on_front="true"),
    ]
    line = chain_glass.glass_line(rows)
    assert line.startswith(
        "PSF of the tracker's glass, dense field, 30 stars: a Gaussian: 12 arcsec"
    )
    assert "a basis of 6 (auto): 0.12 arcsec, 0.4 %, 9 ms" in line
    with charts.panels_of("A finding", 2, share_x=False) as (place, light):
        draw_glass(place, light, rows)
    colours = [chain_glass.colour_of(row) for row in rows]
    assert colours == [charts.INK, charts.RED, charts.BLUE]
    for axes, wanted in ((place, [12.0, 0.125, 0.125]), (light, [3.0, 0.4, 0.2])):
        drawn = set()
        for drawn_line in axes.get_lines():
            drawn.update(zip(*map(np.ravel, drawn_line.get_data()), strict=True))
        for row, error in zip(rows, wanted, strict=True):
            # an error of 0 stands at the smallest other one, on a logarithmic axis
            assert (row.time_ms, error) in drawn
    assert "30 stars" in place.get_title() + place.get_title(loc="left")


def test_a_panel_names_the_scenes_whose_error_is_alike(figures, tmp_path):
    rows = []
    for scene, arcsec in (("average field", 0.23), ("dense field", 0.235), ("faint field", 9.0)):
        own = {"scene": scene, "stars": 12, "on_front": "true"}
        rows.append(row(error_arcsec=arcsec, chosen="auto", **own))
        rows.append(row(error_arcsec=3 * arcsec, time_ms=2.0, **own))
    run.draw(tmp_path / "c", rows, "A finding", "a machine", [])
    (figure,) = figures
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == [
        "Average field, 12 stars (the same in: dense field)",
        "Faint field, 12 stars",
    ]
    assert "The line is the front" in " ".join(figure.get_supxlabel().split())

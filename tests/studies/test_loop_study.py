"""Study `loop`: conditions, intervals, differences episode by episode, a tiny run, and pictures of an episode."""

from __future__ import annotations

import math
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from phibench.datasets.common.errors import DatasetError
from phibench.robot.loop.episodes import Episode
from phibench.robot.loop.robot_pixels import Window
from phibench.robot.loop.simulator import REACHED, WRONG, Setup
from phibench.scenes.motion.vehicle import PARAMETERS
from phibench.scenes.random_streams import generator
from phibench.studies.framework import StudyDatasets, read_settings, rms
from phibench.studies.loop.drawings import episode_steps, pasted_pixels, phases, picture, show_episode
from phibench.studies.loop.study import STUDY, conditions, delay, interval, rig_deviation, summary

TINY = """
episodes = 2
policies = ["paper"]
powers = []
lights = [0]
misalignments = []
rigs = 1
slip_sigmas = []
track_noises = []
sensitivity_episodes = 0
window_episodes = 0
frame_episodes = 0
rooms = 1
"""


def episode(number: int, time_s: float, outcome: str = REACHED) -> Episode:
    return Episode(number, outcome, "", time_s, 1.0, 1.0, 1, 1.0, 1.001, 0.01, 1.5, 1.0, 3.0)


def test_every_parameter_that_is_ours_is_tried_at_both_ends() -> None:
    found = [c for c in conditions(read_settings(STUDY)) if c.group == "vehicle"]
    assert len(found) == 2 * len(PARAMETERS)
    for name in PARAMETERS:
        values = [getattr(c.setups[0].vehicle, name) for c in found if c.name.startswith(f"{name} ")]
        assert values == [PARAMETERS[name].low, PARAMETERS[name].high]


def test_differences_are_taken_episode_by_episode() -> None:
    base = [episode(n, 10.0 + n) for n in range(6)]
    later = [episode(n, 12.0 + n) for n in range(5)] + [episode(5, 90.0, WRONG)]
    assert delay(later, base) == (2.0, 2.0, 2.0)  # of unpaired means it would be 1.5; the lost one counts for nothing
    found = summary(later)
    assert found.reached[0] == pytest.approx(5 / 6)
    assert found.reached[1] < 5 / 6 < found.reached[2] < 1.0
    # by hand: 5 or more of 6 have a chance of 2.5 % at `low`, 5 or fewer at `high`
    low, high = found.reached[1:]
    assert 6 * low**5 * (1.0 - low) + low**6 == pytest.approx(0.025, rel=1e-9)
    assert 1.0 - high**6 == pytest.approx(0.025, rel=1e-9)
    assert summary(later[:5]).reached[1:] == pytest.approx((0.025**0.2, 1.0))  # all of 5
    assert found.time_s[0] == 14.0
    assert math.isnan(interval([1.0, 2.0])[1])


def test_intervals_cover() -> None:
    """Of 200 intervals of the rms of 40 normal numbers 95 % cover 1, percentile bootstraps some 2 % fewer.

    Fewer than 85 % happens in 1e-5 of all cases; rms values that are 20 % off are covered far less often.
    """
    rng, covered, wrong = generator("test", "loop intervals"), 0, 0
    for _ in range(200):
        _, low, high = interval(rng.standard_normal(40), rms)
        covered += low <= 1.0 <= high
        wrong += low <= 1.6 <= high
    assert covered > 170
    assert wrong < 40


def test_misaligned_rigs_grow_with_their_size() -> None:
    one, two, other = rig_deviation(0.5, 0), rig_deviation(1.0, 0), rig_deviation(1.0, 1)
    assert two.decentre_x_m == pytest.approx(2.0 * one.decentre_x_m)
    assert two != other
    assert (two.stroke_relative, two.roughness_alpha) == (0.0, 0.0)
    Setup().rig.perturbed(two)


def test_a_tiny_run(tmp_path: Path) -> None:
    file = tmp_path / "tiny.toml"
    file.write_text(TINY)
    settings = read_settings(STUDY, path=file)
    result = STUDY.run(settings, StudyDatasets(tmp_path, Console(file=StringIO())))
    assert len(result.tables["table"]) == 4
    assert [drawing.name for drawing in result.drawings] == ["conditions", "process"]
    labels = {finding.label: finding for finding in result.findings}
    assert labels["reached, policy paper"].threshold == 95.0
    assert labels["time, other lights 0"].value == pytest.approx(
        np.mean(result.tables["table"].filter(group="other lights")["time_s"].to_numpy())
    )


def test_pictures_of_an_episode(tmp_path: Path) -> None:
    steps = list(episode_steps(Setup(), "paper", "test pictures"))
    simulator, policy, observation, track = steps[-1]
    assert (simulator.outcome, len(track.time_s)) == (REACHED, len(steps))
    assert [name for _, name in phases(track)] == ["identify", "orient", "stroke", "servo"]
    # beliefs belong to their step: at the end the robot stands, and D is known to a few standard deviations
    assert abs(track.believed_m[-2] - track.distance_m[-2]) < 6.0 * track.sigma_m[-2]
    image = picture(simulator, policy, observation, track)
    assert image.shape == (720, 1280, 3)
    assert np.ptp(image) > 200
    with pytest.raises(DatasetError, match=r"ends in \.mp4"):
        show_episode(Setup(), tmp_path / "x.avi", "paper", "test pictures")


def test_windows_are_pasted_at_their_places() -> None:
    pixels = np.arange(64, dtype=np.uint16).reshape(8, 8)
    image = pasted_pixels((Window(4, 2, pixels),), (16, 20))
    assert image[2:10, 4:12].max() == 1.0
    image[2:10, 4:12] = 0.0
    assert not image.any()


@pytest.mark.slow
def test_films_of_episodes_are_written(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    setup = replace(Setup(), task=replace(Setup().task, longest_s=0.5))
    assert show_episode(setup, tmp_path / "x.mp4", "paper", "test pictures") == "time is over"
    with av.open(str(tmp_path / "x.mp4")) as container:
        assert sum(1 for _ in container.decode(video=0)) == 6

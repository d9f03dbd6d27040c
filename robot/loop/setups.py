"""Named settings of the loop, easy, default and hard, and what a policy's episodes in one of them are worth.

| setting | other lights | target, m | rig | power | rooms | slip from run to run |
|---|---|---|---|---|---|---|
| easy | none | 1.5 to 3 | exact | 1 | four walls, some cupboards | 0.02 |
| default | 3 | 1.5 to 4.5 | exact | 1 | the same | 0.02 |
| hard | 5 | 1.5 to 4.5 | as built by hand, told as such | 0.1 | generated, furnished | 0.05 |
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from phibench.benchmark.scores.intervals import clopper_pearson
from phibench.estimator.geometry.rig_parameters import prior_sigmas
from phibench.robot.loop.arena import generated_arena
from phibench.robot.loop.episodes import Episode
from phibench.robot.loop.simulator import Setup, Task
from phibench.scenes.motion.vehicle import Vehicle
from phibench.scenes.validation import SceneError, nearest

Setting = Literal["easy", "default", "hard"]
SETTINGS: tuple[str, ...] = get_args(Setting)
_ROOMS = 20  # of `hard`: each of a hundred episodes meets every room some five times


def named_setup(name: str) -> Setup:
    """Setup of a named setting.

    Raises
    ------
    SceneError
        If there is none of that name.
    """
    if name == "easy":
        return Setup(task=Task(distances_m=(1.5, 3.0), lights=0))
    if name == "default":
        return Setup()
    if name != "hard":
        raise SceneError(f"setting '{name}': {nearest(name, SETTINGS)}")
    return Setup(
        vehicle=Vehicle(slip_sigma=0.05),
        task=Task(lights=5, power=0.1),
        arenas=tuple(generated_arena("loop hard", number) for number in range(_ROOMS)),
        rig_covariance=np.diag(prior_sigmas() ** 2),
        own_rigs=True,
    )


@dataclass(frozen=True)
class LoopScore:
    """Numbers of a policy over episodes.

    Attributes
    ----------
    count, reached : int
        Episodes, and successes among them.
    share_low, share_high : float
        Interval of 95 % of the share of successes (Clopper and Pearson 1934).
    spl : float
        Success weighted by path length, the mean of s l / max(p, l): s is 1 for a success, l the straight way to the
        stand-off distance, p the way driven (P. Anderson et al., arXiv:1807.06757, 2018).
    time_s : float
        Median time of successes; NaN without any.
    pull : float
        Rms error of the inverse distance over its stated standard deviation; NaN where no policy states one.
    pulls : int
        Episodes that have one.
    """

    count: int
    reached: int
    share_low: float
    share_high: float
    spl: float
    time_s: float
    pull: float
    pulls: int

    def sentence(self) -> str:
        """All of it in one line."""
        share = f"reached: {self.reached} of {self.count} (95 %: {100 * self.share_low:.0f} to "
        share += f"{100 * self.share_high:.0f} %); SPL {self.spl:.2f}"
        time = f"; median time {self.time_s:.1f} s" if math.isfinite(self.time_s) else ""
        pull = f"; pull of 1/D {self.pull:.2f} (n {self.pulls})" if self.pulls else ""
        return share + time + pull


def loop_score(episodes: Sequence[Episode]) -> LoopScore:
    """Score of episodes.

    Raises
    ------
    SceneError
        If there are none.
    """
    if not episodes:
        raise SceneError("score of a policy: there are no episodes; run at least one")
    reached = np.array([episode.reached for episode in episodes])
    way = np.array([(episode.shortest_m, episode.driven_m) for episode in episodes])
    # a start at the stand-off distance has no way: to stay there is the straight one
    weight = np.maximum(way[:, 0], 1e-9) / np.maximum(way.max(axis=1), 1e-9)
    times = [episode.time_s for episode in episodes if episode.reached]
    pulls = np.array([episode.pull for episode in episodes if math.isfinite(episode.pull)])
    low, high = clopper_pearson(int(reached.sum()), len(episodes), 0.95)
    return LoopScore(
        len(episodes),
        int(reached.sum()),
        low,
        high,
        float(np.mean(reached * weight)),
        float(np.median(times)) if times else math.nan,
        float(np.sqrt(np.mean(pulls**2))) if len(pulls) else math.nan,
        len(pulls),
    )

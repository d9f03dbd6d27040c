"""Targets followed in the whole frames of a film (`TargetTracker`): detected, identified by blink code, lost.

A target is held while its light follows its code (`blink_identity`).

The log likelihood ratio rises by at most ln 2 per bit and falls for a light that is steady. If a light blinks by
chance, the ratio passes L at any time with a probability of at most 1 / L (J. Ville, 1939): the error of a lock is
stated, however long one looks. L = 2000 takes 11 bits: a code of 15 bits, one a frame, locks within itself, and five
lights that all blink by chance are taken for the target in at most 0.25 % of all films. A phase that is not known takes
log2(phases) bits more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.interface import Box
from phibench.robot.film.blink_identity import Evidence, Exposures, evidence
from phibench.robot.film.spot_tracks import FrameSearch, SpotTrack, SpotTracker
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.motion.film_times import BlinkCode, FilmTimes
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError

LOCK = math.log(2000.0)
"""Log likelihood ratio of a lock."""
REGAIN = 3.0
"""The same of a light that comes back where the target is expected."""
_LONGEST = 60  # frames that count
_PHASES_PER_BIT = 4  # of a code whose beginning is not known: a quarter of a bit off loses little
_CHANGES = 4.0  # standard deviations of chi^2 of a light that is steady


@dataclass(frozen=True)
class TargetCode:
    """Code of a target.

    Parameters
    ----------
    phase_known : bool
        The code begins at `code.start_s`, as of a laser that the robot itself switches; otherwise at any time.
    """

    name: str
    code: BlinkCode
    phase_known: bool = True

    def __post_init__(self) -> None:
        if "0" not in self.code.bits:
            raise SceneError(
                f"target '{self.name}': the code '{self.code.bits[:60]}' is always on, as a lamp is; give one with a 0"
            )

    @property
    def starts_s(self) -> Array:
        """Times at which the code may begin."""
        if self.phase_known:
            return np.array([self.code.start_s])
        count = _PHASES_PER_BIT * len(self.code.bits)
        return np.arange(count) * self.code.bit_s / _PHASES_PER_BIT

    def dark_frames(self, rate_hz: float) -> int:
        """Frames in turn without a spot that the code explains.

        The longest run of zeros, as the code repeats, and as much again where the spot is found by its changes alone.
        """
        longest = max(map(len, (2 * self.code.bits).split("1")))
        return 2 * math.ceil(longest * self.code.bit_s * rate_hz) + 2


@dataclass(frozen=True)
class Hold:
    """Time during which a target is known.

    Attributes
    ----------
    locked, lost : int
        Frame of the lock, and of the loss; -1 where it is known to the end.
    log_odds : float
        At the lock.
    """

    target: str
    track: SpotTrack = field(repr=False)
    locked: int
    lost: int = -1
    log_odds: float = 0.0


@dataclass
class _Search:
    """State of one target."""

    code: TargetCode
    dark_frames: int
    hold: Hold | None = None
    past: SpotTrack | None = None  # the track that was lost
    began: dict[int, int] = field(default_factory=dict)  # frame from which a track's light counts, by its number


class TargetTracker:
    """Targets in the whole frames of a film, frame by frame: detected, associated, identified.

    Parameters
    ----------
    rig : Rig
        Nominal.
    times : FilmTimes
        When each row of each frame is exposed.
    codes : sequence of TargetCode
        Targets to look for, each by a code of its own.
    patience_s : float
        Time after which a light that is not seen is given up.
    box : Box, optional
        Part of the image to search, as of `FrameSearch`.

    Raises
    ------
    SceneError
        If there is no code, two targets share a name, or the film is shorter than a code.

    Examples
    --------
    >>> tracker = TargetTracker(rig, card, times, [TargetCode("target", code)])  # doctest: +SKIP
    >>> for image in film:  # doctest: +SKIP
    ...     tracker.add(image)
    ...     if (track := tracker.held("target")) is not None:
    ...         print(tracker.frame, track.place_px)
    """

    def __init__(
        self,
        rig: Rig,
        card: SensorCard,
        times: FilmTimes,
        codes: Sequence[TargetCode],
        patience_s: float = 1.0,
        box: Box | None = None,
    ) -> None:
        _check(times, codes)
        self.rig, self.times, self.card = rig, times, card
        self._states = {target.name: _Search(target, target.dark_frames(times.rate_hz)) for target in codes}
        tentative = max(state.dark_frames for state in self._states.values())
        self.tracker = SpotTracker(
            FrameSearch(rig, card, box), max(round(patience_s * times.rate_hz), tentative), tentative
        )
        self.holds: list[Hold] = []
        self._rested = 0  # frames since anything moved

    @property
    def frame(self) -> int:
        """Number of the latest frame."""
        return self.tracker.frame

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the targets."""
        return tuple(self._states)

    @property
    def lights(self) -> int:
        """Lights that are followed now."""
        return len(self.tracker.live)

    def held(self, name: str) -> SpotTrack | None:
        """Track of a target; None while it is not known."""
        hold = self._states[name].hold
        return None if hold is None else hold.track

    def add(self, image: NDArray[Any], moves: bool = False) -> None:
        """Take in the next frame.

        Parameters
        ----------
        image : array
            As the camera delivers it.
        moves : bool
            Carriage, robot or target may have moved since the frame before.

        Raises
        ------
        ValueError
            If the image does not fit the card's output.
        """
        self.tracker.add(image, moves)
        self._rested = 0 if moves else self._rested + 1
        for state in self._states.values():
            self._restart(state)
            if state.hold is not None:
                self._check_hold(state, state.hold)
        for state in self._states.values():
            if state.hold is None:
                if not moves:
                    self._follow(state)
                self._try_lock(state)

    def _follow(self, state: _Search) -> None:
        """Look for a light that follows the code at one place, over the latest frames of a rig that rests."""
        count, code = min(self._rested, self.tracker.kept), state.code
        if not code.phase_known or count / (self.times.rate_hz * code.code.bit_s) * math.log(2.0) < LOCK:
            return
        box = self.tracker.search.box
        rows = box.v0_px + np.arange(box.height_px, dtype=float)
        frames = self.frame - count + 1 + np.arange(count, dtype=float)
        times = self.times.row_s(frames[:, None], rows)
        earlier = self.tracker.follow(code.code.mean_level(times, self.times.exposure_s))
        for track in self.tracker.live:
            if track.number in earlier and track.number not in state.began:
                self._choose_start(state, track, earlier[track.number])

    def _choose_start(self, state: _Search, track: SpotTrack, before: int) -> None:
        """Leave the frames out that a track has got, if they speak against the code: something may have hidden it."""
        longer = self.evidence(state, track).log_odds
        state.began[track.number] = before
        if self.evidence(state, track).log_odds <= longer:
            del state.began[track.number]

    def _may_lock(self, state: _Search, track: SpotTrack) -> bool:
        """Quick look: frames enough for a lock, and light that changes by more than its noise."""
        used = self._counting(state, track)
        bits = used.sum() / (self.times.rate_hz * state.code.code.bit_s) + 1.0
        if bits * math.log(2.0) < LOCK:
            return False
        y, weight = np.array(track.electrons)[used], np.array(track.sigma_e)[used] ** -2.0
        mean = float(weight @ y / weight.sum())
        return float(weight @ (y - mean) ** 2) > len(y) + _CHANGES * math.sqrt(2.0 * len(y))

    def _counting(self, state: _Search, track: SpotTrack) -> BoolArray:
        """Frames of a track that count."""
        frames = track.frames
        first = max(state.began.get(track.number, 0), track.last - _LONGEST + 1)
        return np.asarray((frames >= first) & np.isfinite(track.electrons))

    def _restart(self, state: _Search) -> None:
        """Begin anew with a light that was dark for longer than the code ever is: something had hidden it."""
        for track in self.tracker.live:
            if track.detected[-1]:
                gap = next((k for k, seen in enumerate(reversed(track.detected[:-1])) if seen), 0)
                if gap > state.dark_frames:
                    state.began[track.number] = track.last

    def evidence(self, state: _Search, track: SpotTrack) -> Evidence:
        """Evidence for a target of the frames that count."""
        frames, used = track.frames, self._counting(state, track)
        rows = np.array(track.uv_px)[used, 1]
        times = self.times.row_s(frames[used].astype(float), rows)
        code = state.code.code
        exposures = [
            Exposures.of(times, self.times.exposure_s, code.bit_s, float(start)) for start in state.code.starts_s
        ]
        return evidence(np.array(track.electrons)[used], np.array(track.sigma_e)[used], exposures, code.bits)

    def _check_hold(self, state: _Search, hold: Hold) -> None:
        """Give a target up that is dark for too long, or whose light no longer follows its code."""
        track = hold.track
        gone = track.dark > state.dark_frames or track not in self.tracker.live
        if gone or self.evidence(state, track).log_odds < 0.0:
            state.hold, state.past = None, track
            self.holds[self.holds.index(hold)] = Hold(hold.target, track, hold.locked, self.frame, hold.log_odds)

    def _try_lock(self, state: _Search) -> None:
        """Lock on the brightest light that has the code, once no brighter one may have it: a reflection is fainter."""
        taken = {id(other.hold.track) for other in self._states.values() if other.hold is not None}
        candidates = [
            (told, track)
            for track in self.tracker.live
            if id(track) not in taken
            and (track.dark <= state.dark_frames if track is state.past else self._may_lock(state, track))
            and (told := self.evidence(state, track)).log_odds > 0.0
        ]
        sure = [pair for pair in candidates if pair[0].log_odds >= (REGAIN if pair[1] is state.past else LOCK)]
        if not sure:
            return
        best, track = max(sure, key=lambda pair: pair[0].electrons)
        if any(told.electrons > best.electrons for told, _ in candidates):
            return
        state.hold = Hold(state.code.name, track, self.frame, log_odds=best.log_odds)
        self.holds.append(state.hold)

    def seen_places(self, name: str) -> tuple[NDArray[np.int64], Array]:
        """Frames in which a target was detected while it was known, or shortly before its lock, and places (n, 2).

        Raises
        ------
        SceneError
            If the target was never seen.
        """
        self.first_lock(name)
        places: dict[int, tuple[float, float]] = {}
        for hold in (kept for kept in self.holds if kept.target == name):
            track, first = hold.track, hold.locked - math.floor(LOCK / math.log(2.0))
            last = hold.lost if hold.lost >= 0 else track.last
            for number, uv, seen in zip(track.frames.tolist(), track.uv_px, track.detected, strict=True):
                if first <= number <= last and (seen or number == hold.locked):
                    places[number] = uv
        frames = sorted(places)
        return np.array(frames), np.array([places[k] for k in frames])

    def levels(self, name: str, frames: NDArray[np.int64], rows: Array) -> Array:
        """Part of the exposure of a row, in each frame, during which a target's code is on: shape (n,).

        Where the phase of the code is not known, a quarter bit before and after counts as well.
        """
        code, margin_s, start_s = self._states[name].code, 0.0, self._states[name].code.code.start_s
        if not code.phase_known:
            track = next(hold.track for hold in reversed(self.holds) if hold.target == name)
            start_s = float(code.starts_s[self.evidence(self._states[name], track).phase])
            margin_s = 2.0 * code.code.bit_s / _PHASES_PER_BIT
        middle = self.times.row_s(frames.astype(float), rows)
        return replace(code.code, start_s=start_s).mean_level(middle, self.times.exposure_s + margin_s)

    def first_lock(self, name: str) -> Hold:
        """First lock on a target.

        Raises
        ------
        SceneError
            If the target was never seen.
        """
        for hold in self.holds:
            if hold.target == name:
                return hold
        code = self._states[name].code.code
        raise SceneError(
            f"target '{name}' was never seen in {self.frame + 1} frames: none of {self.lights} lights blinks by the "
            f"code {code.bits[:60]}; look longer, turn the robot, or expose longer"
        )


def _check(times: FilmTimes, codes: Sequence[TargetCode]) -> None:
    if not codes:
        raise SceneError("no code to look for; give a TargetCode for each target")
    if len({target.name for target in codes}) < len(codes):
        raise SceneError(f"targets {[target.name for target in codes]} share a name; name each differently")
    for target in codes:
        if times.duration_s < target.code.duration_s * (1.0 - 1e-9):  # a film of just so many frames holds it
            raise SceneError(
                f"film of {times.frames} frames takes {times.duration_s:.3g} s, and the code of '{target.name}' "
                f"{target.code.duration_s:.3g} s: give a film that holds the whole code, or a shorter code"
            )

"""Train an ordinary PPO of stable-baselines3 on `ApproachTargetBelief-easy`, and run it on episodes that it never met.

    pip install 'phibench[loop]' stable-baselines3
    OPENBLAS_NUM_THREADS=1 python docs/train_ppo.py --out out/ppo

Written are `policy.zip`, `curve.csv` and `curve.png`: steps, CPU-s, share of the last 100 training episodes reached.
A `policy.zip` that is there is run without training. A policy of rules runs on the same episodes.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import torch
from matplotlib.figure import Figure
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from phibench.benchmark.scores.intervals import clopper_pearson
from phibench.robot.loop.episodes import SETTINGS

ENVIRONMENT = "phibench.robot.loop.belief_environment:phibench/ApproachTargetBelief-v0"


class Curve(BaseCallback):
    """Share of the latest 100 episodes that was reached, after each rollout; ends training when the time is over."""

    def __init__(self, longest_s: float) -> None:
        super().__init__()
        self.longest_s, self.rows, self.ends = longest_s, [], []

    def _on_step(self) -> bool:
        for over, info in zip(self.locals["dones"], self.locals["infos"], strict=True):
            if over:
                self.ends.append(info["outcome"] == "reached")
        return time.process_time() < self.longest_s

    def _on_rollout_end(self) -> None:
        latest = self.ends[-100:]
        share = sum(latest) / max(len(latest), 1)
        self.rows.append((self.num_timesteps, round(time.process_time(), 1), round(share, 3)))
        print(*self.rows[-1], flush=True)


def trained(longest_s: float, seed: int) -> tuple[PPO, Curve]:
    """Trained policy, and its curve."""
    env = make_vec_env(ENVIRONMENT, 8, seed=seed, env_kwargs={"setup": "easy", "shaped": True})
    model = PPO(
        "MlpPolicy", env, n_steps=256, batch_size=256, n_epochs=10, gamma=0.995, learning_rate=1e-3, ent_coef=0.002,
        policy_kwargs={"log_std_init": -0.5}, seed=seed, device="cpu",
    )  # fmt: skip
    curve = Curve(longest_s)
    model.learn(10_000_000, callback=curve)
    return model, curve


def draw(rows: list[tuple[int, float, float]], out: Path) -> None:
    """Curve of training: share that was reached against CPU time."""
    _, seconds, shares = zip(*rows, strict=True)
    figure = Figure(figsize=(5.2, 2.6), dpi=100, layout="constrained")
    ax = figure.subplots()
    ax.plot(seconds, [100 * share for share in shares], color="#0072b2")
    ax.axhline(70, color="grey", linewidth=0.8, linestyle=":")
    ax.set(xlabel="CPU-s of training", ylabel="reached of the last\n100 episodes, %", ylim=(0, 103), xlim=(0, None))
    figure.savefig(out)


def rules(observation: np.ndarray) -> np.ndarray:
    """Turn to the target, stroke until D is known to 0.5 %, drive to the stand-off distance, state."""
    sin, _, left, enlarged, sigma, stroke, _, _ = observation
    there = abs(enlarged) < 0.2
    drive = turn = carriage = 0.0
    if abs(sin) > 0.05 and not there:
        turn = np.clip(2.0 * sin, -1.0, 1.0)
    elif sigma > -0.15 and stroke < 0.99:
        carriage = 0.6
    else:
        drive = np.clip(8.0 * left, -1.0, 1.0)
    return np.array([drive, turn, carriage, 1.0 if there else -1.0], np.float32)


def outcomes(act: Callable[[np.ndarray], np.ndarray], setting: str, episodes: int) -> list[str]:
    """Outcomes of a policy on episodes of other seeds than those of training, without shaping."""
    env, ends = gymnasium.make(ENVIRONMENT, setup=setting), []
    for number in range(episodes):
        observation, info = env.reset(seed=1_000_000 + number)
        over = late = info["outcome"] != "running"
        while not (over or late):
            observation, _, over, late, info = env.step(act(observation))
        ends.append(info["outcome"])
    return ends


def main() -> None:
    """Train, write, run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--cpu-s", type=float, default=600.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--episodes", type=int, default=100)
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    if (options.out / "policy.zip").is_file():
        model = PPO.load(options.out / "policy.zip", device="cpu")
    else:
        model, curve = trained(options.cpu_s, options.seed)
        model.save(options.out / "policy.zip")
        with (options.out / "curve.csv").open("w", newline="") as file:
            csv.writer(file).writerows([("steps", "cpu_s", "reached"), *curve.rows])
        draw(curve.rows, options.out / "curve.png")
    policies = {"ppo": lambda seen: model.predict(seen, deterministic=True)[0], "rules": rules}
    for setting in SETTINGS:
        for name, act in policies.items():
            ends = outcomes(act, setting, options.episodes)
            reached = ends.count("reached")
            low, high = clopper_pearson(reached, len(ends), 0.95)
            others = {end: ends.count(end) for end in sorted(set(ends)) if end != "reached"}
            share = f"reached {reached} of {len(ends)} (95 %: {100 * low:.0f} to {100 * high:.0f} %)"
            print(f"{setting}, {name}: {share}; {others}", flush=True)


if __name__ == "__main__":
    main()

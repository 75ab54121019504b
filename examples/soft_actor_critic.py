"""Soft actor-critic of Stable-Baselines3, which it needs: `python examples/soft_actor_critic.py`.

The task: put the smaller of two objects into the larger, with primitives as actions.
"""

import argparse

import gymnasium
import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env

import openvima
from openvima.evaluation.statistics import wilson_interval
from openvima.perception.objects import TOP, observe
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW
from openvima.wrappers import FlatAction, ProgressReward


class TwoObjects(gymnasium.ObservationWrapper):
    """Gives where to pick the smaller object and where the larger one lies, scaled as actions are."""

    observation_space = gymnasium.spaces.Box(-1, 1, (4,), np.float32)

    def observation(self, seen):
        """Find the objects in the images; one that hides the other stands for both."""
        objects = observe(seen)
        small, large = objects.boxes[TOP][:, 2:].sum(axis=1).argsort()[[0, -1]]
        points = np.array([objects.grasp_points()[small], objects.positions()[large]])
        low, high = np.array(WORKSPACE_LOW), np.array(WORKSPACE_HIGH)
        return np.clip((points - low) / (high - low) * 2 - 1, -1, 1).ravel().astype(np.float32)


def make(domain="user"):
    """Return the environment. Stable-Baselines3 puts its Monitor around it, so it reports these rewards."""
    env = openvima.make("visual_manipulation", num_distractors=0, domain=domain)
    return ProgressReward(TwoObjects(FlatAction(env)), reach_weight=1.0)


def solved(env, act, episodes):
    """Count the episodes that are solved by `act(state)`."""
    count = 0
    for seed in range(episodes):
        (state, info), is_over = env.reset(seed=seed), False
        while not is_over:
            state, _, terminated, truncated, info = env.step(act(state))
            is_over = terminated or truncated
        count += info["success"]
    return count


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    for name, default in (("steps", 6000), ("episodes", 150), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=default)
    given = parser.parse_args()
    torch.set_num_threads(1)
    sizes = {"learning_rate": 1e-3, "gamma": 0.0, "policy_kwargs": {"net_arch": [128, 128]}}
    # A decision shows its effect at once, so no later reward counts for it.
    model = SAC("MlpPolicy", make_vec_env(make), learning_starts=500, seed=given.seed, verbose=1, **sizes)
    model.learn(given.steps, log_interval=100)  # prints ep_rew_mean
    env = make("eval")
    env.action_space.seed(given.seed)
    ways = {
        "random actions": lambda state: env.action_space.sample(),
        "soft actor-critic": lambda state: model.predict(state, deterministic=True)[0],
    }
    for way, act in ways.items():
        count = solved(env, act, given.episodes)
        low, high = wilson_interval(count, given.episodes)
        rate = f"{100 * count / given.episodes:.1f} % ({100 * low:.1f} to {100 * high:.1f})"
        print(f"{way}: solved {count} of {given.episodes}, {rate}", flush=True)

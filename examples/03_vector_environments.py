"""Run several environments in worker processes: `python examples/03_vector_environments.py`.

The sub-environments have different tasks and prompts; one policy acts in all of them.
"""

import numpy as np
from gymnasium.vector.utils import iterate

import openvima
from openvima.env import stack_actions
from openvima.policies import load_policy

TASKS = ["visual_manipulation", {"task": "rotate", "level": "L2"}]  # the others are at level L1, as below


def play_round(envs, policy, seeds):
    """Run one episode in every sub-environment; return which were solved."""
    observations, _ = envs.reset(seed=seeds)
    policy.reset(envs.get_attr("prompt"))  # one prompt per sub-environment
    solved, running = np.zeros(envs.num_envs, bool), np.ones(envs.num_envs, bool)
    while running.any():
        rows = list(iterate(envs.observation_space, observations))  # one observation per sub-environment
        actions = policy.act([row if running[i] else None for i, row in enumerate(rows)])
        # A finished episode is followed by another one, which waits for the end of the round.
        observations, rewards, terminated, truncated, _ = envs.step(stack_actions(actions))
        solved |= running & (rewards == 1)
        running &= ~(terminated | truncated)
    return solved


def main():
    """Run eight rounds with a random policy."""
    envs = openvima.make_vec(TASKS, 4, num_workers=2, level="L1", domain="eval")
    policy = load_policy("random", seed=0)  # or the folder of a run that `openvima train` wrote
    try:
        solved = [play_round(envs, policy, list(range(first, first + 4))) for first in range(0, 32, 4)]
        _, infos = envs.reset(seed=0)
        for task, prompt in zip(infos["task"], infos["prompt"], strict=True):
            print(f"{task}: {prompt}")
        print("Solved at random:", int(np.sum(solved)), "of", np.size(solved))
    finally:
        envs.close()


if __name__ == "__main__":  # workers import this file
    main()

"""Behaviour cloning and DAgger from equally many labels of the oracle: `python examples/dagger.py`.

The task: put the smaller of two objects into the larger, by commands of the tool, ten a second. Behaviour
cloning learns from states that the oracle visits. DAgger (Ross, Gordon and Bagnell, 2011) lets the policy act
in four of five steps, and asks the oracle what it would have done.
"""

import argparse
from functools import partial

import gymnasium
import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

import openvima
from openvima.evaluation.statistics import wilson_interval
from openvima.perception.objects import TOP, observe
from openvima.scene.action import COMMAND_HIGH, MAX_MOVE_M


class Errors(gymnasium.ObservationWrapper):
    """Gives from the tool to where to pick, from the object to the base, the tool's height, and its hold."""

    def observation(self, seen):
        """Look at the objects while the tool is empty; what it holds moves with it."""
        x, y, z, _, holds = seen["tool"]
        if not holds and len(objects := observe(seen)) == 2:
            small, large = objects.boxes[TOP][:, 2:].sum(axis=1).argsort()
            self.pick, self.base = objects.grasp_points()[small], objects.positions()[large]
            self.offset = objects.positions()[small] - self.pick
        pick = np.array([x, y]) if holds else self.pick
        errors = np.append(pick - (x, y), self.base - pick - self.offset)
        return np.array([*np.clip(errors / MAX_MOVE_M, -1, 1), *(3 * errors), 6 * z - 1, holds], np.float32)


def make(domain):
    """Return the environment; an episode has 7 s."""
    env = openvima.make("visual_manipulation", domain=domain, num_distractors=0, control="end_effector")
    return gymnasium.wrappers.TimeLimit(Errors(env), 70)


def train(states, labels, steps, seed):
    """Fit a new network to the labels: motions as fractions of the fastest, and whether suction is on."""
    torch.manual_seed(seed)
    states, labels = torch.tensor(np.array(states)), torch.tensor(np.array(labels))
    network = nn.Sequential(nn.Linear(10, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, 5))
    optimizer = torch.optim.AdamW(network.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-2, total_steps=steps)
    for _ in range(steps):
        batch = torch.randint(len(states), (64,))
        motion, suction = network(states[batch]).split([4, 1], -1)
        wrong = F.binary_cross_entropy_with_logits(suction, labels[batch, 4:])
        loss = F.l1_loss(motion, labels[batch, :4]) + wrong
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return network


@torch.no_grad()
def act(network, state):
    """Return the command of a network for a state."""
    *motion, suction = network(torch.tensor(state)).numpy()
    return np.array([*np.clip(motion, -1, 1), suction > 0], np.float32)


def play(env, seed, choose):
    """Play an episode with commands `choose(state)`; return whether it was solved."""
    state, info = env.reset(seed=seed)
    is_over = False
    while not is_over:
        command = choose(state) * np.array(COMMAND_HIGH)
        state, _, terminated, truncated, info = env.step(command)
        is_over = terminated or truncated
    return info["success"]


def learn(rounds, num_labels, steps, seed):
    """DAgger; with a single round it is behaviour cloning."""
    env, rng = make("train"), np.random.default_rng(seed)
    states, labels, network, episode = [], [], None, 100_000 * seed

    def choose(state):
        if network is not None and rng.random() < 0.6:
            return act(network, state)
        states.append(state)
        labels.append((env.unwrapped.oracle_command().to_array() / COMMAND_HIGH).astype(np.float32))
        return labels[-1] if network is None or rng.random() < 0.5 else act(network, state)

    for number in range(1, rounds + 1):
        while len(states) < num_labels * number // rounds:
            play(env, episode, choose)
            episode += 1
        del states[num_labels * number // rounds :], labels[num_labels * number // rounds :]
        network = train(states, labels, steps, seed)
    return network


parser = argparse.ArgumentParser()
for name, default in (("labels", 600), ("rounds", 6), ("steps", 800), ("episodes", 150), ("seed", 0)):
    parser.add_argument(f"--{name}", type=int, default=default)
parser.add_argument("--domain", default="eval")
given = parser.parse_args()
torch.set_num_threads(1)
for method, rounds in (("behaviour cloning", 1), ("DAgger", given.rounds)):
    network, env = learn(rounds, given.labels, given.steps, given.seed), make(given.domain)
    solved = sum(play(env, seed, partial(act, network)) for seed in range(given.episodes))
    low, high = wilson_interval(solved, given.episodes)
    rate = f"{100 * solved / given.episodes:.1f} % ({100 * low:.1f} to {100 * high:.1f})"
    print(f"{method}, {given.labels} labels: solved {solved} of {given.episodes}, {rate}", flush=True)

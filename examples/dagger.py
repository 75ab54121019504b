"""Behaviour cloning and DAgger from equally many labels of the oracle: `python examples/dagger.py`.

The task: sweep blocks into an area, around a line at its mouth; no other block is on the table. Behaviour
cloning learns from states that the oracle visits. DAgger (Ross, Gordon and Bagnell, 2011) lets the policy act
in seven of ten steps, and asks the oracle what it would have done.
"""

import argparse

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

import openvima
from openvima.evaluation.statistics import wilson_interval
from openvima.wrappers import FlatAction, FlatObservation


class Sweeper(nn.Module):
    """Scores each object on the table, and says where a sweep of it starts and ends."""

    def __init__(self, width=64):
        super().__init__()
        self.embed = nn.Sequential(nn.Linear(5, width), nn.ReLU(), nn.Linear(width, width))
        self.head = nn.Sequential(nn.Linear(2 * width, width), nn.ReLU(), nn.Linear(width, 5))

    def forward(self, rows):
        """Rows (B, N, 5) hold present, x, y, height, width; returns scores (B, N) and sweeps (B, N, 4)."""
        objects = self.embed(rows) * rows[..., :1]
        table = objects.amax(1, keepdim=True).expand_as(objects)
        scores, start, end = self.head(torch.cat([objects, table], -1)).split([1, 2, 2], -1)
        return scores[..., 0] - 1e4 * (1 - rows[..., 0]), torch.cat([rows[..., 1:3] + 0.3 * start, end], -1)

    @torch.no_grad()
    def act(self, rows):
        """Return the sweep of the object with the highest score, as a flat action."""
        scores, sweeps = self(torch.tensor(rows)[None])
        return np.append(sweeps[0, scores[0].argmax()].clamp(-1, 1).numpy(), np.zeros(2, np.float32))


def train(states, labels, steps, seed):
    """Fit a new network to the labels; the object to sweep is the block nearest to the start of the sweep."""
    torch.manual_seed(seed)
    network, rows = Sweeper(), torch.tensor(np.array(states))
    targets = torch.tensor(np.array(labels))[:, :4]
    distances = (rows[..., 1:3] - targets[:, None, :2]).norm(dim=-1)
    is_block = (rows[..., 0] > 0) & (rows[..., 3:5].sum(-1) < 0.25)
    blocks = distances.masked_fill(~is_block, 10).argmin(-1)
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 5e-3, total_steps=steps)
    for _ in range(steps):
        batch = torch.randint(len(rows), (64,))
        scores, sweeps = network(rows[batch])
        error = (sweeps[torch.arange(64), blocks[batch]] - targets[batch]).abs().mean()
        loss = F.cross_entropy(scores, blocks[batch]) + 5 * error
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return network


def make(domain):
    """Return the environment, with vectors as observations and actions."""
    env = openvima.make("sweep_without_touching", domain=domain, num_distractors=0, difficulty="hard")
    return FlatObservation(FlatAction(env), max_objects=6)


def play(env, seed, choose):
    """Play an episode with actions `choose(rows)`; return whether it was solved."""
    observation, info = env.reset(seed=seed)
    is_over = False
    while not is_over:
        observation, _, terminated, truncated, info = env.step(choose(env.rows(observation)[0][:, :5].copy()))
        is_over = terminated or truncated
    return info["success"]


def learn(rounds, num_labels, steps, seed):
    """DAgger; with a single round it is behaviour cloning."""
    env, rng = make("train"), np.random.default_rng(seed)
    states, labels, network, episode = [], [], None, 100_000 * seed

    def ask(rows):
        states.append(rows)
        labels.append(FlatAction.flatten(env.unwrapped.oracle_decision().action))
        return labels[-1] if network is None or rng.random() < 0.3 else network.act(rows)

    for number in range(1, rounds + 1):
        while len(states) < num_labels * number // rounds:
            play(env, episode, ask)
            episode += 1
        del states[num_labels * number // rounds :], labels[num_labels * number // rounds :]
        network = train(states, labels, steps, seed)
    return network


parser = argparse.ArgumentParser()
for name, default in (("labels", 150), ("rounds", 6), ("steps", 1000), ("episodes", 400), ("seed", 0)):
    parser.add_argument(f"--{name}", type=int, default=default)
given = parser.parse_args()
torch.set_num_threads(1)
for method, rounds in (("behaviour cloning", 1), ("DAgger", given.rounds)):
    network, env = learn(rounds, given.labels, given.steps, given.seed), make("eval")
    solved = sum(play(env, seed, network.act) for seed in range(given.episodes))
    low, high = wilson_interval(solved, given.episodes)
    rate = f"{100 * solved / given.episodes:.1f} % ({100 * low:.1f} to {100 * high:.1f})"
    print(f"{method}, {given.labels} labels: solved {solved} of {given.episodes}, {rate}", flush=True)

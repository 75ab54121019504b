"""A training loop of your own: `python examples/own_training_loop.py DEMOS EPOCHS`."""

import sys

import torch
from torch.nn.functional import cross_entropy
from torch.utils.data import DataLoader

from openvima.data.torch_dataset import DemonstrationDataset
from own_network import WEIGHTS, make

policy = make()
optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-3)
loader = DataLoader(DemonstrationDataset(sys.argv[1]), batch_size=16, shuffle=True)
for epoch in range(int(sys.argv[2])):
    for batch in loader:
        top, segm = batch["rgb_top"][:, 0], batch["segm_top"][:, 0]  # at the first step
        logits = policy(top, segm, batch["prompt_rgb_top"], batch["prompt_segm_top"])
        targets = torch.stack([batch["pick_ids"][:, 0], batch["place_ids"][:, 0]], dim=1)
        loss = cross_entropy(logits.flatten(0, 1), targets.flatten())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    print(f"epoch {epoch}, loss {loss:.2f}")
torch.save(policy.state_dict(), WEIGHTS)

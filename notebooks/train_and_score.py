# %% [markdown]
# # Train and score a policy
#
# Demonstrations, training and evaluation in one place. The sizes below take seconds and teach little.
# `openvima quickstart` runs the same steps with 900 demonstrations in five to nine minutes and solves 95 %
# and more of its three tasks.

# %%
from pathlib import Path

from openvima.data import Dataset, GenerateConfig, generate
from openvima.evaluation import score
from openvima.policies import RandomPolicy, load_policy
from openvima.training import TrainingConfig, train
from openvima.training.config import LoaderConfig, PretrainingConfig, ScheduleConfig

DEMONSTRATIONS, STEPS = 40, 10  # 900 and 400 are a start

# %% [markdown]
# ## Demonstrations
#
# The oracle solves episodes of the domain `train`, whose seeds no evaluation uses.

# %%
folder = generate(
    GenerateConfig(Path("demos"), tasks=("visual_manipulation",), episodes=DEMONSTRATIONS, workers=1)
)
data = Dataset(folder)
data

# %%
data[0]

# %% [markdown]
# ## Training
#
# First the encoder of object crops is trained to match prompt images with objects in view, then the network
# is trained by behaviour cloning. The run folder keeps settings, metrics and checkpoints, and an
# interrupted run resumes.

# %%
run = train(
    TrainingConfig(
        data=folder,
        out=Path("run"),
        preset="nano",
        loader=LoaderConfig(batch_size=8),
        pretraining=PretrainingConfig(steps=5, num_scenes=20, batch_size=16),
        schedule=ScheduleConfig(steps=STEPS, warmup_steps=2, checkpoint_every=STEPS),
    )
)
sorted(path.name for path in run.iterdir())

# %% [markdown]
# ## Scores
#
# The trained policy, random actions and the checkpoint that is included, on the same episodes of the domain
# `eval`.

# %%
policies = {
    "mine": load_policy(str(run)),
    "random": RandomPolicy(),
    "openvima-small": load_policy("openvima-small"),
}
results = score(policies, tasks=("visual_manipulation",), levels=("L1",), episodes=10)
results

# %%
for row in results.rows:
    print(f"{row.policy:15} {row.successes:3} of {row.episodes}")

# %% [markdown]
# From the command line, with videos and a report:
#
# ```sh
# openvima generate --tasks visual_manipulation --episodes 900 --out demos
# openvima train --data demos --preset nano --out run
# openvima evaluate --policy run --tasks visual_manipulation --out scores
# ```

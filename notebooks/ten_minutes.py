# %% [markdown]
# # The benchmark in ten minutes
#
# Each episode shows a robot arm a table and a prompt of words and images. The policy returns one action a
# step: where to pick and where to place, or where to sweep from and to. A script in jupytext's percent
# format: it opens as a notebook in Jupyter and VS Code.

# %%
import openvima
from openvima.evaluation import score
from openvima.policies import RandomPolicy, load_policy
from openvima.tasks import sample_episode, task_spec

openvima.list_tasks()

# %% [markdown]
# ## One episode
#
# `reset` samples a scene. The same task, level and seed give the same bytes on every machine. In a notebook
# the environment shows its prompt and both views.

# %%
env = openvima.make("visual_manipulation", level="L1")
observation, info = env.reset(seed=3)
env

# %% [markdown]
# The observation has colours and object ids for both views, and the end effector.

# %%
for view in observation["rgb"]:
    print(view, observation["rgb"][view].shape, "segmentation", observation["segm"][view].shape)

# %% [markdown]
# The oracle is a scripted solver with access to the scene. Its action has the form that a policy returns.

# %%
decision = env.oracle_decision()
decision.action.to_arrays()

# %%
observation, reward, terminated, truncated, info = env.step(decision.action.to_arrays())
print("solved:", info["success"], "reward:", reward, "over:", terminated)
env

# %% [markdown]
# ## Four levels
#
# Policies train on 13 tasks. L1 has new placements of known objects, L2 new combinations of objects and
# textures, L3 new objects and textures, L4 tasks that were not trained.

# %%
sample_episode("visual_manipulation", level="L3", seed=0)

# %%
sample_episode("same_texture", level="L4", seed=0)

# %% [markdown]
# A task is data: a template, its levels, a tool, a step limit.

# %%
spec = task_spec("rotate")
print(spec.template, spec.levels, spec.end_effector, spec.max_steps, sep="\n")

# %% [markdown]
# ## A pretrained policy
#
# `openvima-small` is included. `play` takes an episode and the name of a policy.

# %%
result = openvima.play(sample_episode("rotate", level="L3", seed=1), "openvima-small")
result.outcome

# %% [markdown]
# ## Scores
#
# `score` plays the episodes of `openvima evaluate`. Ten of them give wide intervals; the protocol has 200
# for each task and level.

# %%
policies = {"openvima-small": load_policy("openvima-small"), "random": RandomPolicy()}
score(policies, tasks=("visual_manipulation", "rotate"), levels=("L1", "L3"), episodes=10)

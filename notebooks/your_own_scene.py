# %% [markdown]
# # Your own scene and words
#
# A scene is a few objects with textures and positions; the sentence is free. No task needs to be written.

# %%
import numpy as np
from PIL import Image

import openvima
from openvima.catalog import OBJECTS, TEXTURES

print(len(OBJECTS), "objects:", ", ".join(list(OBJECTS)[:8]), "…")
print(len(TEXTURES), "textures:", ", ".join(list(TEXTURES)[:8]), "…")

# %% [markdown]
# ## A scene
#
# An object is its name, texture and position in metres: x points away from the robot, y to its left. A
# fourth entry is the heading in degrees. `{block}` shows an image of the object in the prompt. Goals say
# when the episode is solved.

# %%
objects = {
    "block": ("block", "red", (0.45, -0.25)),
    "bowl": ("bowl", "green", (0.55, 0.25)),
    "heart": ("heart", "blue", (0.6, -0.05), 40),
}
goals = [("in", "block", "bowl")]
episode = openvima.compose(objects, "Put the {block} into the {bowl}.", goals=goals)
episode

# %%
result = openvima.play(episode, "openvima-small", frames=True)
result.outcome

# %% [markdown]
# Both views before and after:

# %%
Image.fromarray(np.concatenate([result.frames[0], result.frames[-1]], axis=1))

# %% [markdown]
# ## Words alone
#
# The same in words: the policy has to find the objects that the sentence describes.

# %%
described = openvima.compose(objects, "Put the red block into the green bowl.", goals=goals)
openvima.play(described, "openvima-small").outcome

# %% [markdown]
# Another sentence about the same scene, with the heart this time:

# %%
other = openvima.compose(objects, "Put the blue heart into the green bowl.", goals=[("in", "heart", "bowl")])
openvima.play(other, "openvima-small").outcome

# %% [markdown]
# ## A goal image
#
# `images` gives other contents: here a whole scene, with the heart somewhere else.

# %%
rearrange = openvima.compose(
    objects,
    "Rearrange to this {scene}.",
    images={"scene": [("heart", (0.4, 0.05))]},
    goals=[("at", "heart", (0.4, 0.05))],
)
rearrange

# %%
openvima.play(rearrange, "openvima-small").outcome

# %% [markdown]
# ## What cannot be
#
# Objects that overlap, or reach beyond the table, are refused with the limit.

# %%
try:
    openvima.compose([("heart", "red", (0.74, 0.1))], "Rotate the {a} 30 degrees.")
except openvima.errors.SceneError as error:
    print(error)

# %% [markdown]
# ## Files
#
# An episode, sampled or composed, is saved as data and plays alike on every machine.

# %%
openvima.save_episode(episode, "scene.yaml")
print("equal:", openvima.load_episode("scene.yaml") == episode)

"""Find the objects that a sentence names, and put them where it says: `python examples/language_prompts.py`.

With `prompts="text"`, prompts describe objects instead of showing them. This reader sees no image of the
prompt; it knows the names of the objects on the table, where a policy that reads language has eyes.
"""

import numpy as np

import openvima
from openvima.perception.objects import observe
from openvima.scene import Action

EPISODES = 20


def named(prompt, objects):
    """Return the ids of the objects that a prompt describes, in the order of the text."""
    places = {i: prompt.find(f"the {words['texture']} {words['object']}") for i, words in objects.items()}
    return sorted((i for i, place in places.items() if place >= 0), key=places.__getitem__)


for task in ("visual_manipulation", "rotate"):
    env = openvima.make(task, level="L3", prompts="text")
    solved = 0
    for seed in range(EPISODES):
        observation, info = env.reset(seed=seed)
        ids = named(info["prompt"], info["objects"])
        seen = observe(observation)
        pick = seen.grasp_points()[seen.ids.tolist().index(ids[0])]
        place = pick if task == "rotate" else seen.positions()[seen.ids.tolist().index(ids[1])]
        angle = int(info["prompt"].split()[-2]) if task == "rotate" else 0
        action = Action.planar(tuple(pick), tuple(place), -np.deg2rad(angle))
        solved += env.step(action.to_arrays())[-1]["success"]
    print(f'"{info["prompt"]}" and {EPISODES - 1} others: solved {solved}')

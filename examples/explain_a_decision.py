"""Ask a policy what it considered: `python examples/explain_a_decision.py`.

The explanation of an action: probabilities of objects, places and rotations, and attention to the prompt.
"""

import numpy as np

import openvima
from openvima.policies import load_policy

env = openvima.make("rearrange", level="L1", domain="eval")
policy = load_policy("openvima-small")
observation, info = env.reset(seed=3)
policy.reset([env.prompt])

print("Prompt:", info["prompt"])
while True:
    (action,) = policy.act([observation])
    (explanation,) = policy.explain()  # of the last action, one for each episode of the batch
    print(f"Step {info['num_steps'] + 1}")
    for each in sorted(explanation.objects, key=lambda each: -each.probability):
        names = info["objects"][each.object_id]
        print(f"  pick   {each.probability:6.1%}  {names['texture']} {names['object']}")
    for place in sorted(explanation.places, key=lambda place: -place.probability)[:2]:
        print(f"  place  {place.probability:6.1%}  {place.kind}, {np.round(place.position, 2)} m")
    if len(explanation.yaw_rad):  # openvima-vima rotates by `bins`
        best = explanation.yaw_probabilities.argmax()
        angle = np.rad2deg(explanation.yaw_rad[best])
        print(f"  rotate {explanation.yaw_probabilities[best]:6.1%}  {angle:.0f}°, counter-clockwise above 0")
    for kind, weights in explanation.attention.items():
        print(f"  the {kind} attends to {explanation.prompt[weights.argmax()]} most: {weights.max():.0%}")
    observation, _, terminated, truncated, info = env.step(action)
    if terminated or truncated:
        break
print("Solved:", info["success"])

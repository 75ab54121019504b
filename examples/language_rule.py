"""The model of `vla_policy.py`: a rule for `visual_manipulation` and `rotate` that reads words for colours.

It finds what a prompt of text describes in the top view, by colours alone. Objects of other names are not for
it: textures without colours, such as "wooden", and two objects of the same colours.
"""

import re

import numpy as np

from openvima.catalog.textures import BASE_COLOURS, DARK_VALUE_DROP
from openvima.render.camera import TOP, unproject

BRIGHTNESS = 0.937  # of surfaces that face upwards
FASTEST = (0.05, 0.05, 0.05, 0.2)  # of a command: metres along x, y, z, and radians


def components(mask):
    """Number the connected pixels of a mask alike; 0 elsewhere."""
    numbers, before = np.arange(1, mask.size + 1).reshape(mask.shape) * mask, mask
    while not np.array_equal(numbers, before):
        before = numbers
        for shift, axis in ((1, 0), (-1, 0), (1, 1), (-1, 1)):
            numbers = np.maximum(numbers, np.roll(numbers, shift, axis)) * mask
    return numbers


def find(description, image):
    """Return pixels, rows and columns, of what has the colours of a description in equal shares."""
    colours = [np.array(BASE_COLOURS[word]) for word in re.findall("|".join(BASE_COLOURS), description)]
    if "dark" in description:
        colours = [colour * (1 - 255 * DARK_VALUE_DROP / colour.max()) for colour in colours]
    if re.search("swirl|paisley", description):
        colours.append(np.full(3, 255))  # beside white
    near = [np.abs(image / BRIGHTNESS - colour).max(axis=2) < 16 for colour in colours]
    numbers = components((image != np.median(image, axis=(0, 1))).any(axis=2))  # the table is left out,
    numbers[numbers == numbers[0, 0]] = 0  # and the floor around it
    objects = [numbers == number for number in np.unique(numbers)[1:]]
    return np.argwhere(max(objects, key=lambda at: sum(min(a[at].mean(), 1 / len(near)) for a in near)))


def read(text, image):
    """Return what a prompt asks for: points of pick and place in metres, and a rotation in radians."""
    descriptions = re.findall(r"the (.+?)(?= into |\.| \d)", text)
    pick, place = (find(description, image) for description in (descriptions[0], descriptions[-1]))
    nearest = np.abs(pick - pick.mean(axis=0)).sum(axis=1).argmin()  # a ring has no middle
    points = np.array([pick[nearest], pick[nearest] if " into " not in text else place.mean(axis=0)], float)
    angle = re.search(r"(\d+) degrees", text)
    return *unproject(points[:, ::-1], TOP), -np.deg2rad(float(angle[1])) if angle else 0.0


def primitive(text, images, state):
    """Decide a primitive: 12 numbers."""
    pick, place, yaw = read(text, images["top"])
    return np.array([*pick, 0, 0, 0, 1, *place, 0, 0, np.sin(yaw / 2), np.cos(yaw / 2)], np.float32)


def commands(text, images, state):
    """Decide all commands of a pick and a place: rows of 5 numbers."""
    pick, place, yaw = read(text, images["top"])
    pose, rows = state[6:10], []  # of the tool: x, y, z, yaw
    turns = np.array([0, 0, 0, yaw, yaw, yaw]) + pose[3]
    path = ((pick, 0.2, 0), (pick, 0, 1), (pick, 0.2, 1), (place, 0.2, 1), (place, 0, 1), (place, 0, 0))
    for ((x, y), z, suction), turn in zip(path, turns, strict=True):  # z = 0 is beyond contact
        delta = np.subtract((x, y, z, turn), pose)
        count = max(1, int(np.ceil(np.abs(delta / FASTEST).max())))
        rows += [[*delta / count, suction]] * count
        pose = (x, y, z, turn)
    return np.array(rows, np.float32)

"""Extractors of objects as a user would write them, named by `plugged_extractors.py:truth` and the like."""

from openvima.perception.objects import GROUND_TRUTH, make_hidden_objects


def truth():
    """What the segmentation says."""
    return GROUND_TRUTH


class Blind:
    """Finds nothing on the table, and in a prompt two objects that no view shows."""

    def in_observation(self, observation):
        return make_hidden_objects()

    def in_prompt_image(self, image):
        return make_hidden_objects(2)

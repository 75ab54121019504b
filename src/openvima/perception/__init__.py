"""From images to objects: boxes, crops and grasp points by segmentation; no torch."""

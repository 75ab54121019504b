"""Tables of objects in a form that is easily compared."""

import numpy as np

from openvima.perception.preprocessing import ObjectTable


def rows_of(table: ObjectTable) -> np.ndarray:
    """All fields of each object in one row: id, two indices of images, two boxes, two grasp points."""
    columns = (table.ids, table.crop_index, table.boxes, table.grasps)
    return np.concatenate(
        [column.reshape(len(table), int(np.prod(column.shape[1:]))) for column in columns], axis=1
    )

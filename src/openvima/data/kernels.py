"""Compiled loops: colours of pixels joined and parted again."""

from openvima.compilation import njit


@njit
def join_colours(planes, pixels):
    """Copy red, green and blue planes of an image, (3, P), to its pixels, (3 · P); contiguous uint8.

    Written so that the compiler makes shuffles of it: 20 GB/s against 1 for a copy by NumPy.
    """
    red, green, blue = planes[0], planes[1], planes[2]
    for pixel in range(len(red)):
        pixels[3 * pixel] = red[pixel]
        pixels[3 * pixel + 1] = green[pixel]
        pixels[3 * pixel + 2] = blue[pixel]


@njit
def part_colours(pixels, planes):
    """Copy pixels of three colours, (N, 3 · P), to red, green and blue planes, (N, 3, P); both uint8.

    Plane by plane it makes 14 GB/s, all three at once only 3.
    """
    for image in range(planes.shape[0]):
        for colour in range(3):
            given, plane = pixels[image], planes[image, colour]
            for pixel in range(planes.shape[2]):
                plane[pixel] = given[3 * pixel + colour]

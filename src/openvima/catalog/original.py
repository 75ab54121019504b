"""The original asset pack: meshes, textures and collision shapes of VIMA-Bench, and their import.

Files come from a checkout, or from copies in the cache. Every file is compared with a known hash, so that an
incomplete or different pack is reported.
"""

import hashlib
import io
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np

from openvima.atomic_io import atomic_write_file
from openvima.catalog.bodies import BOX_SHAPES, fixed_geometry
from openvima.catalog.geometry import CollisionHull, Geometry, TriangleMesh, Vector3, product
from openvima.catalog.mesh_files import ObjMesh, parse_obj
from openvima.catalog.meshes import scale_geometry
from openvima.catalog.objects import ObjectSpec, object_spec
from openvima.catalog.procedural import CataloguePack
from openvima.catalog.textures import texture_spec
from openvima.errors import AssetError
from openvima.input_files import cache_dir, read_json

PACK_FOLDER = Path("vima_bench/tasks/assets")  # inside a checkout


def find_pack(checkout: str | Path) -> Path:
    """Return the absolute folder of the pack in a checkout.

    Args:
        checkout: Folder of the checkout (it holds `vima_bench/tasks/assets`), or that assets folder.

    Raises:
        AssetError: The folder holds no asset pack.
    """
    for path in (Path(checkout) / PACK_FOLDER, Path(checkout)):
        if (path / "textures").is_dir():
            return path.resolve()
    raise AssetError(
        f"{checkout} holds no original asset pack ({PACK_FOLDER}/textures is missing); "
        "give the folder of a VIMABench checkout."
    )


def imported_folder() -> Path:
    """Return where an import keeps its files."""
    return cache_dir() / "original-pack-2"


def imported_pack() -> Path:
    """Return the folder of the imported pack.

    Raises:
        AssetError: None was imported.
    """
    if not imported_folder().is_dir():
        raise AssetError(
            f"the original asset pack has not been imported ({imported_folder()} is missing). Run "
            "`openvima assets import CHECKOUT` with the folder of a VIMABench checkout, or use the pack "
            "'procedural'."
        )
    return imported_folder()


def read_original(pack: Path, relative_path: str) -> bytes:
    """Return a file's content, as in the original benchmark.

    Args:
        pack: Folder of the pack.
        relative_path: One of `known_hashes`.

    Raises:
        AssetError: The file is missing, unreadable, damaged or of another version.
    """
    path = pack / relative_path
    advice = "restore it from a fresh checkout of VIMABench, or by `openvima assets import CHECKOUT`"
    try:
        content = path.read_bytes()
    except OSError as error:
        raise AssetError(f"{path} is missing or unreadable; {advice}.") from error
    if hashlib.sha256(content).hexdigest() != known_hashes()[relative_path]:
        raise AssetError(
            f"{path} differs from the file of the original benchmark (damaged, or another version); {advice}."
        )
    return content


@lru_cache(maxsize=1)
def known_hashes() -> Mapping[str, str]:
    """Return the SHA-256 of every file that is imported, by path in the pack."""
    return read_json(Path(__file__).with_name("original_files.json"))


def import_pack(checkout: str | Path) -> list[str]:
    """Import the original asset pack for `load_assets("original")`: copy what has the known hash.

    Args:
        checkout: Folder of a checkout of the original benchmark, or its assets folder.

    Returns:
        One sentence for each file that is missing or damaged.

    Raises:
        AssetError: The folder contains no asset pack, or only damaged files.
        OSError: The cache cannot be written to.
    """
    source = find_pack(checkout)
    problems = _check_files(source, copy_to=imported_folder())
    if len(problems) == len(known_hashes()):
        raise AssetError(f"none of the {len(problems)} files in {source} is sound; {problems[0]}")
    return problems


def _check_files(pack: Path, copy_to: Path | None = None) -> list[str]:
    """Check every file of a pack, and copy the sound ones; return a sentence for each of the others."""
    problems = []
    for relative_path in known_hashes():
        try:
            content = read_original(pack, relative_path)
        except AssetError as error:
            problems.append(str(error))
        else:
            if copy_to is not None:
                atomic_write_file(copy_to / relative_path, content)
    return problems


# Of meshes that are not of the kit: metres per mesh unit, and the height at which their origin rests.
_SCALES: dict[str, tuple[Vector3, float]] = {
    "bowl": ((2.2, 2.2, 0.5), 0.0),
    "pallet": ((0.175, 0.175, 0.175), 0.0131),
    "frame": ((0.009, 0.009, 0.000075), 0.0),
    "pan": ((0.825, 0.825, 0.825 / 1.1), 0.0137),
    "disk": ((0.0015, 0.0015, 0.003), 0.015),
}
_BOWL_PARTS = ("bowl/cup.obj", (2.2, 2.2, 0.4))  # 14 convex parts, a fifth flatter than what is drawn


class OriginalAssets(CataloguePack):
    """The shapes and textures of VIMA-Bench; implements `Assets`.

    Args:
        source: Folder of a checkout of VIMA-Bench, its assets folder, or that of the import.

    Raises:
        AssetError: The folder contains no asset pack.
    """

    name = "original"

    def __init__(self, source: str | Path) -> None:
        self.folder = imported_pack() if source == imported_folder() else find_pack(source)

    def __repr__(self) -> str:
        return f"OriginalAssets({str(self.folder)!r})"

    def problems(self) -> list[str]:
        """Check every file of the pack.

        Returns:
            One sentence for each file that is missing or differs from the original; empty if all is well.
        """
        return _check_files(self.folder)

    def build(self, object_name: str, size: Vector3, scale: Vector3) -> Geometry:
        """Build a shape from the mesh files.

        Raises:
            UnknownNameError: The catalogue has no such object.
            AssetError: A mesh is missing or damaged.
        """
        spec = object_spec(object_name)
        if object_name in BOX_SHAPES:
            return BOX_SHAPES[object_name](product(size, scale))
        if object_name == "stand":  # which has no mesh file
            return scale_geometry(fixed_geometry("stand with long rods"), scale)
        try:
            return self._from_file(spec, scale)
        except AssetError as error:
            raise AssetError(f"object {object_name!r} cannot be used: {error}") from error

    def load_image(self, texture_name: str) -> np.ndarray:
        """Load the image of a texture.

        Raises:
            AssetError: The image is missing or damaged.
        """
        from PIL import Image

        try:
            content = read_original(self.folder, texture_spec(texture_name).original_file)
        except AssetError as error:
            raise AssetError(f"texture {texture_name!r} cannot be used: {error}") from error
        with Image.open(io.BytesIO(content)) as image:
            return np.array(image.convert("RGB"))

    def _from_file(self, spec: ObjectSpec, scale: Vector3) -> Geometry:
        kit = spec.kit_scale or 1.0
        metres, rest_z_m = _SCALES.get(spec.name, ((0.003 * kit, 0.003 * kit, 0.001 * kit / 1.1), 0.0))
        visual = _scale(_mesh(self.folder, spec.original_file), product(metres, scale))
        collision = (_hull(visual.vertices),)
        if spec.name == "bowl":
            parts_file, parts_metres = _BOWL_PARTS
            factors = product(parts_metres, scale)
            collision = tuple(_hull(part * factors) for part in _mesh(self.folder, parts_file).pieces())
        return Geometry(visual, collision, rest_z_m * scale[2])


def _scale(mesh: ObjMesh, metres: Vector3) -> TriangleMesh:
    """Scale positions only: the benchmark lights every mesh with the normals of its file."""
    return TriangleMesh(mesh.vertices * np.array(metres), mesh.normals, mesh.uvs)


def _hull(vertices: np.ndarray) -> CollisionHull:
    return CollisionHull(np.unique(vertices.reshape(-1, 3), axis=0))


@lru_cache(maxsize=64)
def _mesh(pack: Path, relative_path: str) -> ObjMesh:
    content = read_original(pack, relative_path)
    return parse_obj(content.decode("utf-8", errors="replace"), relative_path)

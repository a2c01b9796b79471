"""Clean a mesh with MeshLab's filters; run as a program of its own with one thread: ``clean_mesh.py IN.ply
OUT.ply MIN_FACES``.

MeshLab's library is GPL-3 and is only ever talked to through files. Islands with fewer faces than
MIN_FACES, duplicates, slivers and non-manifold edges go; colours and the outline of holes stay.
"""

import sys

import pymeshlab


def clean(source: str, target: str, min_faces: int) -> None:
    """Read a PLY, clean it and write it with vertex colours."""
    # Its module is a compiled one without stubs, filled in when it is imported.
    meshes = pymeshlab.MeshSet(verbose=False)  # pyright: ignore[reportAttributeAccessIssue]
    meshes.load_new_mesh(source)
    meshes.meshing_remove_duplicate_vertices()
    meshes.meshing_remove_duplicate_faces()
    meshes.meshing_remove_null_faces()
    meshes.meshing_remove_connected_component_by_face_number(mincomponentsize=min_faces, removeunref=True)
    meshes.meshing_repair_non_manifold_edges()
    meshes.apply_coord_taubin_smoothing(stepsmoothnum=3)
    meshes.meshing_remove_unreferenced_vertices()
    meshes.save_current_mesh(
        target, save_vertex_normal=False, save_vertex_quality=False, save_wedge_texcoord=False
    )


if __name__ == "__main__":
    clean(sys.argv[1], sys.argv[2], int(sys.argv[3]))

"""Clean a mesh with MeshLab's filters, as a separate process: ``clean_mesh.py IN.ply OUT.ply MIN_FACES``.

pymeshlab is GPL-3, so it is used only through files. Removes connected components with fewer faces than
MIN_FACES, duplicates, degenerate faces and non-manifold edges; keeps vertex colors and holes.
"""

import sys

import pymeshlab


def clean(source: str, target: str, min_faces: int) -> None:
    """Read a PLY, clean it and write it with vertex colors."""
    # The compiled module has no stubs; its members exist only at run time.
    meshes = pymeshlab.MeshSet(verbose=False)  # pyright: ignore[reportAttributeAccessIssue]
    meshes.load_new_mesh(source)
    meshes.meshing_remove_duplicate_vertices()
    meshes.meshing_remove_duplicate_faces()
    meshes.meshing_remove_null_faces()
    meshes.meshing_remove_connected_component_by_face_number(mincomponentsize=min_faces, removeunref=True)
    if not meshes.current_mesh().face_number():
        return  # no component is large enough
    meshes.meshing_repair_non_manifold_edges()
    meshes.apply_coord_taubin_smoothing(stepsmoothnum=3)
    meshes.meshing_remove_unreferenced_vertices()
    meshes.save_current_mesh(
        target, save_vertex_normal=False, save_vertex_quality=False, save_wedge_texcoord=False
    )


if __name__ == "__main__":
    clean(sys.argv[1], sys.argv[2], int(sys.argv[3]))

"""Faces: the smooth pieces of what is scanned, parted at creases and depth edges.

A face that is flat or bulges cannot light itself. Lit alone it is free of bounces up to its very end, which no search
for emitters reaches: towards a crease a place and the emitter of its bounce meet.

Faces begin where round one is sure (`scanner.faces.seeds`): normals that change little from pixel to pixel. They grow
over places that round one leaves open to whatever continues them (`scanner.faces.growing`): of a pixel's two paths, in
any order, the one on the face is known by it.
"""

from scanner.faces.growing import compile_all
from scanner.faces.parting import Faces, find_faces

__all__ = ["Faces", "compile_all", "find_faces"]

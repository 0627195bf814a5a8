"""A 3DGS file of an object becomes a body that falls, without any video:  mosa-splats ply=object.ply prior=corotated"""

from mosa.cli.configured import command

main = command(__name__, "mosa.splats.objects:drop")

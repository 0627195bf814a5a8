"""A 3DGS file of an object becomes a body that falls, without any video:  python -m mosa.splats ply=object.ply"""

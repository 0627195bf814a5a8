"""From phone videos to a scene that trains (docs/capture.md):  python -m mosa.capture videos=... poses=... output=...

Videos of one fall by phones that stand still, and their poses in any world. What nothing else says is found from the free fall: the
phones' clocks, the time their sensors take to be read, metres and down. Frames come out at common times, with mattes, in metres.
"""

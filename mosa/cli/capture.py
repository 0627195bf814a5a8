"""From phone videos to a scene that trains:  mosa-capture videos=<folder> poses=<COLMAP model> output=<folder>"""

from mosa.cli.configured import command

main = command(__name__, "mosa.capture.making:make")

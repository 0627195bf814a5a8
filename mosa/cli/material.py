"""Fit a law to stress-strain tests:  mosa-material tests=heart.csv unit=kPa prior=hgo adapter=operator"""

from mosa.cli.configured import command

main = command(__name__, "mosa.material_tests.run:fit_tests")

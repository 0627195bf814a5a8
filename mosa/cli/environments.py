"""Policies trained in a twin and tested in the hidden truth:  mosa-environments task=placement checkpoint=..."""

from mosa.cli.configured import command

main = command(__name__, "mosa.environments.command:train_and_test")

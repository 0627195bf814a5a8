"""Imported by the server of `processes` before anything else: signals that stop a whole group of processes wait in it for ever, as
it goes last, and in its forks until these answer them. A fork that ignored them would lose a stop that falls into its start."""

import signal

from mosa.experiments.processes import STOPS

signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)

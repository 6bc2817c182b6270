"""A preload of local workers: a Ctrl-C in the terminal is for the command, which stops them in order."""

import signal

signal.signal(signal.SIGINT, signal.SIG_IGN)

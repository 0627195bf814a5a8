"""The commands of the package: mosa-train and mosa-eval, which are train.py and eval.py of a clone, and mosa-view."""

"""The paper's tables and figures: each is a file in `specifications`, and one command runs its jobs and writes its results.

python -m mosa.experiments table_generalisation --dry-run"""

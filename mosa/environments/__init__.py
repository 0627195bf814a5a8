"""Tasks for policies on top of a twin: placement of an elastic object, hanging on a tower (docs/environments.md).

The tasks and the search by gradients need nothing beyond the package; `gymnasium_api` needs the extra `environments`.
"""

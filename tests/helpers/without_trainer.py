"""The stages of a `LitMosa` without a trainer."""


def identify(module) -> None:
    """All stages by Gauss-Newton: nothing is logged or kept. Errors: those of an iteration."""
    while (stage := module.stage) is not None:
        module.begin(stage)
        module.identification = module.begun(stage)
        for _ in range(stage.iterations):
            module.identification.iterate()
            if module.identification.converged:
                break
        if module.goes_back(stage):
            continue
        module.keep_posterior(stage)
        module.end(stage)

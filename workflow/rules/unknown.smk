# `scenes/My room`, `scenes/a/b`, `--forcerun bse`: without this rule, Snakemake says only that no rule makes it.


rule unknown_target:
    """Explain why nothing makes a target, and what was probably meant."""
    input:
        unknown,
    output:
        touch("{target}"),
    wildcard_constraints:
        target=made_by_no_rule(),
    localrule: True

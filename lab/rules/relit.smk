# Studies whose scores are of pictures under new light. The source is rendered once for all variants.


use rule stage as relit_truth with:
    input:
        unpack(product.reads("relit_truth", "capture")),
    pathvars:
        stage="relit_truth",
    resources:
        **product.needs("relit_truth"),
    params:
        job=product.job("relit_truth"),
    message:
        "{wildcards.scene}: the source under new light"


use rule stage as relit_scores with:
    input:
        unpack(
            product.reads(
                "relit_scores",
                "capture",
                "segmentation",
                "base",
                "emission",
                "second_look",
                "affines",
                "relit_truth",
            )
        ),
    pathvars:
        stage="relit_scores",
    resources:
        **product.needs("relit_scores"),
    params:
        job=product.job("relit_scores"),
    message:
        "{wildcards.scene}: the result under new light, and its scores"


workflow.get_rule("relit_truth").docstring = (
    "Render the source of a scene with truth under new light."
)
workflow.get_rule("relit_scores").docstring = (
    "Render the result under new light and score it against the source."
)

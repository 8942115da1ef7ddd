"""The paper's datasets as captures, and the scores by which it compares methods on them; one module a dataset.

A module of a dataset has

    convert(scene, folder)     writes the scene as a capture to a new folder, with the dataset's split
    measure(scene, capture, results)     returns the figures of a trained reconstruction
    TRAINING                   options of `train`, as in the paper
    AFTER_TRAINING             the command that makes what `measure` needs
    FIGURES                    key -> (label, form) of the figures, in the order of the table
    paper(scene)               the paper's figures of a scene, or of "mean", by key
    NOTES                      sentences below the table: what its figures are
"""

"""Results of a recipe: artifacts of its runs → one tidy table, figures and pages.

artifacts       JSON files that the other stages write, strictly validated
runs            artifacts of all methods, seeds and sizes → Results
results         Results: what results.json holds, as tables; merging, summaries
statistics      means, differences and correlations over seeds, with intervals
choice          the choice without the target, what it is worth there, and trials that end it
held_out        errors of groundings on held-out episodes, and their page
verdict         which method to deploy, by a rule
page            Results → sections of a page: a column of its table is a line of `COLUMNS`
figures         Results → figures: a figure is a line of `FIGURES`
blocks          sections → Markdown and HTML
"""

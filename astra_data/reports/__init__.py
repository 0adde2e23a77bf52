"""Results of a recipe: artefacts of its runs → tables, figures and a page.

artefacts     JSON files that the other stages write, strictly validated
runs          where those files are, for all rows and seeds
schema        Results: what results.json holds
seed_table    Results as a tidy table: one line per row and seed
costs         times and speeds of the artefacts
assembly      artefacts → Results
merging       Results of several places → one
comparing     summaries over seeds, comparisons of rows, predictive validity
statistics    interquartile means, bootstrap intervals, correlations
origins       code, machine and datasets, each once
command_replay   identical commands in simulator and target
drawing       Results → figures
page          Results → Markdown
sizes         Results at each dataset size, and their page
cost_and_origin   text on cost and origin
formatting    numbers, tables and templates of the pages
rerun_view    episodes of a dataset in Rerun, with replays
files         results, page and figures → a folder
"""

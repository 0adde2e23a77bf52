"""Results of a recipe: artifacts of its runs → tables, figures and a page.

artifacts     JSON files that the other stages write, strictly validated
runs          where those files are, for all rows and seeds
schema        Results: what results.json holds
seed_table    Results as a tidy table: one line per row and seed
costs         times and speeds of the artifacts
assembly      artifacts → Results
mean_bands    errors by horizon, averaged over seeds
merging       Results of several places → one
comparing     summaries over seeds, comparisons of rows, predictive validity
choice        the choice without the target: who was judged how, and what it is worth there
choice_page   the choice → Markdown
halving       which candidates of a choice are tried in the target, and how often
trials        what was tried, and its lines on a page
losses        where each row loses: from its simulator to the target, by failures, by time
verdict       which row to deploy, in a sentence or two
tested        the words for where rows were tested
statistics    interquartile means, bootstrap intervals, correlations
origins       code, machine and datasets, each once
command_replay   identical commands in simulator and target
drawing       Results → figures
page          Results → Markdown
html_page     Results → one HTML page
eval_info     Results → eval_info.json, as `lerobot-eval` writes it
sizes         Results at each dataset size, and their page
cost_and_origin   text on cost and origin
formatting    numbers, tables and templates of the pages
held_out      errors of groundings on held-out episodes, and their page
files         results, page and figures → a folder
"""

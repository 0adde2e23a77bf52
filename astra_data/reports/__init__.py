"""What a recipe's runs amount to.

artefacts     read the JSON that the other stages left behind, strictly
runs          find those files for all rows and seeds
schema        Results: what results.json holds
costs         what the artefacts took
assembly      artefacts → Results
merging       Results of several places → one
comparing     rows → their summaries, and how they compare
origins       where results come from, each said once
drawing       Results → figures
page          Results → Markdown
sizes         Results of each size of the dataset, and their page
files         results, pages and figures → a folder
cost_and_origin   the sections of pages on cost and origin
formatting    their numbers and tables
"""

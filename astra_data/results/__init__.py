"""What a recipe's runs amount to.

artefacts     read the JSON that the other stages left behind, strictly
runs          find those files for all rows and seeds
model         Results: what results.json holds
costs         what the artefacts took
assembly      artefacts → Results
page          Results → Markdown
making        its sections on cost and origin
cells         its numbers and tables
provenance    commit, machine and package versions, for every stage to record
"""

"""The page on which a person looks at scenes and has new ones drawn: viser's, on this machine only.

All browsers see one page: a sample, a slider or a layer that one of them changes is changed for all of them, and each
has a camera of its own. Refusals and files go to the browser whose person caused them.
"""

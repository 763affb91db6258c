"""A viser page on this machine, on which a person looks at scenes and draws new ones.

All browsers share the page: a sample, a slider or a layer that one of them changes is changed for all, but each has its
own camera. Error messages and files go only to the browser that caused them.
"""

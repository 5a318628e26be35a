"""The live page: what the rig does, in a browser, with nothing from outside hosts.

``feed`` takes records off the pipeline thread through a bounded queue, ``server`` has a thread of
its own and serves the page and a websocket, ``access`` says who may do what, ``source`` is what is
shown: a running session, or a recording at its own pace.
"""

"""Click correspondences between a session and the walk-through, to evaluate a real capture's registration.

`stage` picks frames worth clicking, `serving` hands the page (`page.html`) its pictures on 127.0.0.1,
fits what was clicked and keeps it in `captures/<agent>/clicks.json`, which `evaluate` reads.
"""

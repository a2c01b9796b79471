"""Click the same things in a session and in the walk-through, to measure a real capture's registration.

`frame_choice` picks frames worth clicking, `serving` hands the page (`page.html`) its pictures on 127.0.0.1,
fits what was clicked and keeps it in `captures/<agent>/clicks.json`, which `evaluate` reads.
"""

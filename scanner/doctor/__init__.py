"""What `scan doctor` does: look at machine and devices, and say whether a scan could start.

Whatever is looked at is looked at in processes of their own with a time limit (`bounded`), because a vendor's library
may crash and a disk or a display may hang. `machine` measures, `examinations` asks the installed packages and the bench
about devices, `readiness` judges one configuration, `page` prints. Nothing is projected.
"""

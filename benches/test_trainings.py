#!/usr/bin/env python3
"""Tests of benches/trainings.py: python3 benches/test_trainings.py"""
import json
import multiprocessing
import pathlib
import tempfile
import unittest

from trainings import Rows

PROCESSES, EACH = 4, 10


def keep_some(file, process):
    rows = Rows(file)
    for number in range(EACH):
        rows.keep({"process": process, "number": number})


class TestRows(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.file = pathlib.Path(folder.name) / "rows.json"

    def test_two_that_share_a_file_find_and_keep_the_rows_of_each_other(self):
        first, second = Rows(self.file), Rows(self.file)
        self.assertIsNone(first.find({"name": "a"}))
        first.keep({"name": "a", "psnr_db": 30.0})
        second.keep({"name": "b", "psnr_db": 31.0})
        self.assertEqual([row["name"] for row in json.loads(self.file.read_text())], ["a", "b"])
        self.assertEqual(second.find({"name": "a"})["psnr_db"], 30.0)
        self.assertEqual(first.find({"name": "b"})["psnr_db"], 31.0)
        self.assertIsNone(first.find({"name": "b", "seed": 1}))

    def test_no_row_of_several_processes_is_lost(self):
        context = multiprocessing.get_context("spawn")
        processes = [context.Process(target=keep_some, args=(self.file, number)) for number in range(PROCESSES)]
        for process in processes:
            process.start()
        for process in processes:
            process.join()
        found = {(row["process"], row["number"]) for row in json.loads(self.file.read_text())}
        self.assertEqual(found, {(process, number) for process in range(PROCESSES) for number in range(EACH)})


if __name__ == "__main__":
    unittest.main()

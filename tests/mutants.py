"""The faults that `test_mutants` puts into the code, by the module that they are in."""

# ruff: noqa: E501 - a fragment of code is easiest to read on a line of its own

from __future__ import annotations

from collections.abc import Iterator

from tests.mutate import Mutant

AGREEMENT = "tests/query/predicate/test_agreement.py"
MASK = "tests/query/predicate/test_to_mask.py"
JSON_ARRAYS = f"{AGREEMENT}::test_what_json_arrays_answer"
INTERVALS = "tests/query/test_intervals.py"
LEDGER = "tests/test_losses.py"


def _of(file: str, *mutants: tuple[str, str, str, str]) -> Iterator[Mutant]:
    """Mutants of one file: name, what is there, what stands for it, a test."""
    for name, old, new, test in mutants:
        yield Mutant(name, file, old, new, (test,))


MUTANTS = [
    *_of(
        "hybridlog/query/predicate/to_bool.py",
        (
            "true-is-no-number-in-a-summary",
            "value * 1  # True counts as 1",
            "value",
            f"{AGREEMENT}::test_of_ros_messages",
        ),
        (
            "triggers-ignore-types",
            "stat = self.types.statistic(parts)",
            "stat = FieldTypes.of(None).statistic(parts)",
            f"{AGREEMENT}::test_of_ros_messages",
        ),
        (
            "infinities-are-in-order",
            "if element and isinstance(found, float) and math.isinf(found):",
            "if False:",
            f"{AGREEMENT}::test_of_ros_messages",
        ),
        (
            "a-field-called-n-is-no-field",
            'if stat == "n":\n        return not any(',
            'if stat == "n":\n        return True or not any(',
            JSON_ARRAYS,
        ),
    ),
    *_of(
        "hybridlog/query/predicate/to_mask.py",
        (
            "a-null-is-missing",
            "        possible[leaves.rows] = True\n            if leaves.is_hidden",
            "        possible[leaves.rows[_valid(leaves.values)]] = True\n            if leaves.is_hidden",
            f"{MASK}::test_nulls",
        ),
        (
            "floats-as-narrow-as-the-column",
            "numbers.astype(np.float64, copy=False)",
            "numbers",
            MASK,
        ),
    ),
    *_of(
        "hybridlog/query/predicate/numbers.py",
        (
            "integers-meet-the-other-neighbour",
            '(math.ceil if order in {"<", ">="} else math.floor)',
            '(math.floor if order in {"<", ">="} else math.ceil)',
            MASK,
        ),
        (
            "doubles-meet-the-other-neighbour",
            "near if near < value else",
            "near if near > value else",
            MASK,
        ),
    ),
    *_of(
        "hybridlog/query/predicate/tokens.py",
        (
            "any-element-of-any-element",
            "if is_element and of_any:",
            "if False:",
            "tests/query/predicate/test_language.py::test_errors_point_at_the_place",
        ),
    ),
    *_of(
        "hybridlog/query/intervals.py",
        (
            "touching-intervals-meet-below",
            'low = np.searchsorted(theirs[:, 1], mine[:, 0], "right")',
            'low = np.searchsorted(theirs[:, 1], mine[:, 0], "left")',
            INTERVALS,
        ),
        (
            "touching-intervals-meet-above",
            'high = np.searchsorted(theirs[:, 0], mine[:, 1], "left")',
            'high = np.searchsorted(theirs[:, 0], mine[:, 1], "right")',
            INTERVALS,
        ),
        (
            "the-longest-gap-overflows",
            "np.minimum(begin, END - self._max_gap) + self._max_gap",
            "begin + self._max_gap",
            f"{INTERVALS}::test_a_state_may_be_believed_for_ever",
        ),
    ),
    *_of(
        "hybridlog/record/recorder.py",
        (
            "nothing-behind-the-last-message",
            "        self._copy_extras()\n        for channel in",
            "        for channel in",
            "tests/formats/test_mcap.py::test_what_stands_behind_the_last_message_is_recorded",
        ),
    ),
    *_of(
        "hybridlog/live/recorder.py",
        (
            "numbers-of-more-than-32-bits",
            "sequence % _SEQUENCES",
            "sequence",
            "tests/live/test_recorder.py::"
            "test_a_number_of_more_than_32_bits_is_kept_by_its_lower_ones",
        ),
    ),
    *_of(
        "hybridlog/live/recording.py",
        (
            "chunks-flushed-three-intervals-late",
            "flush_older(interval * _FLUSH_AT - 2 * tick)",
            "flush_older(3 * interval)",
            "tests/live/test_recording.py::test_chunks_are_flushed_within_the_interval",
        ),
    ),
    *_of(
        "hybridlog/index/index_writer.py",
        (
            "missed-messages-are-none",
            "return self._flushed - self.indexed if self.failure is not None else 0",
            "return 0",
            "tests/live/test_recording.py::"
            "test_a_database_that_refuses_to_the_end_leaves_what_segments_know",
        ),
        (
            "the-index-begins-behind-what-it-has",
            "(added.segment, added.chunk + 1)",
            "(added.segment, added.chunk + 2)",
            "tests/live/test_recording.py::test_documents_of_many_chunks_are_sent_together",
        ),
    ),
    *_of(
        "hybridlog/live/sources/foxglove/session.py",
        (
            "gaps-are-dropped-when-a-server-leaves",
            "                self._report(channel.topic, gaps.finish())\n",
            "                pass\n",
            "tests/live/sources/test_foxglove.py::test_gaps_of_header_numbers_are_rows",
        ),
    ),
    *_of(
        "hybridlog/live/sources/sequence_gaps.py",
        (
            "a-gap-of-a-server-begins-at-its-end",
            "self.jump(number, self._received, received)",
            "self.jump(number, received, received)",
            "tests/live/sources/test_foxglove.py::test_gaps_of_header_numbers_are_rows",
        ),
    ),
    *_of(
        "hybridlog/live/sources/ros1/stream.py",
        (
            "a-gap-of-a-publisher-begins-at-its-end",
            "                    gaps.jump(number, self._last, now)\n",
            "                    gaps.jump(number, now, now)\n",
            "tests/live/sources/test_ros1_parts.py::test_dropped_messages_are_counted",
        ),
    ),
    *_of(
        "hybridlog/record/losses.py",
        ("a-loss-begins-late", "min(row.first, first)", "row.first", LEDGER),
        ("a-loss-ends-early", "max(row.last, last)", "row.last", LEDGER),
        ("a-row-ends-early", 'max(before["to"], row["to"])', 'row["to"]', LEDGER),
        ("rows-apart-are-joined", "<= _JOINED_NS:", "<= 2 * _JOINED_NS:", LEDGER),
        ("rows-of-wishes-never-come", "row.last - row.first >= _SLOW_NS", "False", LEDGER),
    ),
    *_of(
        "storage/hybridlog_storage/disk/append_file.py",
        (
            "a-file-ends-in-zeros",
            "                files.system.truncate(self._fd, self.position)\n",
            "                pass\n",
            "tests/storage/test_append_file.py",
        ),
        (
            "what-is-behind-the-last-block-is-lost",
            "end = whole + BLOCK if rest else whole",
            "end = whole",
            "tests/storage/test_append_file.py",
        ),
    ),
    *_of(
        "storage/hybridlog_storage/disk/durability.py",
        (
            "a-write-that-was-cut-short-skips-a-byte",
            "return [view[done:], *views[index + 1 :]]",
            "return [view[done + 1 :], *views[index + 1 :]]",
            "tests/storage/test_append_file.py",
        ),
        (
            "a-full-disk-is-any-error",
            "if error.errno in NO_SPACE:",
            "if False:",
            "tests/live/test_recorder.py::test_a_full_disk_ends_it_and_what_comes_is_counted",
        ),
    ),
]

JOURNAL = "tests/storage/test_journal.py"
POWER = "tests/test_power_cut.py"
REPAIR = "tests/test_repair.py"
IDENTITY = "tests/test_identity.py"
ENTRIES = "tests/test_entries.py"
SNAPSHOT = "tests/test_snapshot.py"
RECOVERY = "tests/storage/test_recovery.py"
SEGMENTS = "tests/storage/test_segments.py"
CATALOG = "tests/storage/test_catalog.py"
STEPS = "tests/faults/test_some.py"

FORMAT_2 = [
    *_of(
        "hybridlog/query/engines/tables.py",
        (
            "bounds-hide-unreadable-messages",
            "if bounds is not None and not self._counts[part].unreadable:",
            "if bounds is not None:",
            "tests/test_narrowing.py::test_recordings_whose_documents_may_not_tell_are_asked",
        ),
    ),
    *_of(
        "storage/hybridlog_storage/journal.py",
        (
            "a-journal-is-not-synced",
            "                    if self._sync:\n",
            "                    if False:\n",
            JOURNAL,
        ),
        ("a-new-journal-has-no-name", "if self._sync and size == 0:", "if False:", JOURNAL),
        (
            "a-torn-line-stays",
            "                if whole < size:\n",
            "                if False:\n",
            JOURNAL,
        ),
        ("a-line-is-believed", 'if line[:9] != b"%08x " % crc32(line[9:]):', "if False:", JOURNAL),
        (
            "a-failed-append-stays",
            "                    files.system.truncate(fd, whole)\n                    raise",
            "                    raise",
            JOURNAL,
        ),
        ("an-older-journal-is-not-kept", "        if old:\n", "        if False:\n", REPAIR),
        (
            "a-damaged-line-proves",
            "return bool(self.begun) and not self.damaged and",
            "return bool(self.begun) and",
            ENTRIES,
        ),
        ("a-rebuilt-journal-proves", "and self.rebuilt is None", "", REPAIR),
    ),
    *_of(
        "hybridlog/entries.py",
        ("a-missing-segment-is-no-loss", "            found.lost.append(sealed)\n", "", ENTRIES),
        (
            "a-foreign-segment-is-believed",
            "if its_id != recording:",
            "if False:",
            ENTRIES,
        ),
        ("a-swapped-segment-is-believed", "if its_number != number:", "if False:", ENTRIES),
        (
            "an-older-segment-is-believed",
            "if sealed is not None and (summary.digest",
            "if False and (summary.digest",
            ENTRIES,
        ),
        ("losses-are-no-damage", "    if has_losses:\n", "    if False:\n", ENTRIES),
        ("unproven-is-complete", "    if not inventory.is_proven:\n", "    if False:\n", ENTRIES),
    ),
    *_of(
        "hybridlog/maintenance/opening.py",
        (
            "a-removal-is-not-finished",
            "if state is not None and state.removing:",
            "if False:",
            f"{IDENTITY}::test_a_removal_that_was_announced_is_finished",
        ),
        (
            "what-was-removed-is-not-swept",
            "            if name.startswith(REMOVED):\n",
            "            if False:\n",
            STEPS,
        ),
        (
            "a-crash-has-no-end",
            "if state is not None and state.end is None:",
            "if False:",
            f"{REPAIR}::test_a_recording_without_its_end_gets_one",
        ),
        (
            "files-that-changed-are-believed",
            "    if looks != listing.print:\n        return False\n",
            "",
            f"{IDENTITY}::test_the_copy_that_is_whole_answers",
        ),
        (
            "a-lost-journal-stays-lost",
            "        report.journals.append(label)\n        inventory = take",
            "        inventory = take",
            REPAIR,
        ),
    ),
    *_of(
        "hybridlog/maintenance/edit.py",
        (
            "documents-of-a-removed-recording-stay",
            "    remove_documents(database, entry.key, indexed)\n",
            "",
            STEPS,
        ),
    ),
    *_of(
        "hybridlog/snapshot.py",
        (
            "recordings-that-end-when-a-range-begins-are-in-it",
            "(self.end[places] > low)]",
            "(self.end[places] >= low)]",
            f"{SNAPSHOT}::test_recordings_are_chosen_by_topic_and_time",
        ),
        (
            "one-example-is-enough",
            "for place in places[np.sort(firsts)].tolist()]",
            "for place in places[np.sort(firsts)][:1].tolist()]",
            f"{SNAPSHOT}::test_recordings_are_chosen_by_topic_and_time",
        ),
        (
            "open-recordings-have-an-end",
            "end = np.where(self.is_open, _LATEST, self.end)",
            "end = self.end",
            f"{SNAPSHOT}::test_an_open_recording_may_have_messages_at_any_time",
        ),
    ),
    *_of(
        "hybridlog/query/planner.py",
        (
            "a-long-recording-hides-no-overlap",
            "reached = np.maximum.accumulate(last[order]) if len(order) else last",
            "reached = last[order]",
            f"{SNAPSHOT}::test_messages_are_in_order_however_recordings_are_grouped",
        ),
        (
            "backwards-is-grouped-as-forwards",
            "            first, last = -last, -first\n",
            "            pass\n",
            f"{SNAPSHOT}::test_messages_are_in_order_however_recordings_are_grouped",
        ),
    ),
    *_of(
        "hybridlog/session.py",
        (
            "a-renamed-recording-is-gone",
            "                entry = self._current(now.summaries[now.by_id[summary.id]])\n",
            "                return None\n",
            "tests/faults/test_meanwhile.py::test_a_recording_that_is_renamed_is_not_missed",
        ),
    ),
    *_of(
        "hybridlog/maintenance/opening.py",
        (
            "a-look-is-not-looked-at",
            "if summary is None or summary.look != look or",
            "if summary is None or",
            f"{SNAPSHOT}::test_a_journal_that_has_grown_is_read_at_the_opening",
        ),
    ),
    *_of(
        "hybridlog/maintenance/lease.py",
        (
            "a-copied-store-is-taken-for-the-original",
            "    if embedded or None in where or _has_moved(mark, place):",
            "    if True:",
            f"{IDENTITY}::test_a_copied_store_with_a_uri_is_noticed_and_removes_nothing",
        ),
        (
            "a-moved-store-is-taken-for-a-copy",
            "or _has_moved(mark, place)",
            "",
            f"{IDENTITY}::test_a_moved_store_takes_its_index_along",
        ),
    ),
    *_of(
        "hybridlog/maintenance/places.py",
        (
            "an-import-is-not-checked",
            "return not any(True for _ in check.problems())",
            "return True",
            f"{IDENTITY}::test_what_is_damaged_is_not_imported",
        ),
        (
            "an-import-is-not-adopted",
            'content = lines + b"".join(map(journal.encode, added))',
            "content = lines",
            f"{IDENTITY}::test_import",
        ),
    ),
    *_of(
        "hybridlog/maintenance/copying.py",
        (
            "an-import-begins-anew",
            "self._bring(sent, file, begun.sizes.get(file.file, 0))",
            "self._bring(sent, file, 0)",
            f"{IDENTITY}::test_an_import_goes_on_where_it_was_stopped",
        ),
    ),
    *_of(
        "hybridlog/maintenance/edit.py",
        (
            "a-mark-is-no-line",
            "Journal(path).append(marked, sealed_event(sealed))",
            "Journal(path).append(sealed_event(sealed))",
            f"{IDENTITY}::test_names_tags_notes_and_marks_are_kept",
        ),
    ),
    *_of(
        "hybridlog/maintenance/repair.py",
        (
            "what-was-exchanged-stays",
            "                files.rename(path / misfit.file, path / moving_name(misfit.file, misfit.belongs))\n",
            "                pass\n",
            REPAIR,
        ),
    ),
    *_of(
        "storage/hybridlog_storage/segments/recovery.py",
        (
            "another-summary-takes-its-place",
            "        if segment.complete().digest != digest:\n            return False\n",
            "        segment.complete()\n",
            REPAIR,
        ),
        (
            "a-recovered-segment-has-no-end",
            "if damage or not rebuilder.has_end:",
            "if False:",
            RECOVERY,
        ),
        ("a-recovery-is-not-announced", "        on_sealed(found)\n", "", SEGMENTS),
    ),
    *_of(
        "storage/hybridlog_storage/segments/segment_file.py",
        (
            "a-sealed-segment-has-no-name",
            "            files.sync_folder(final.parent)\n        except OSError",
            "            pass\n        except OSError",
            SEGMENTS,
        ),
        (
            "a-segment-is-announced-when-it-has-its-name",
            "            on_sealing(sealed)\n            if self.path != final:\n                files.rename(self.path, final)\n                self.path = final\n",
            "            if self.path != final:\n                files.rename(self.path, final)\n                self.path = final\n            on_sealing(sealed)\n",
            SEGMENTS,
        ),
        (
            "a-sealed-segment-is-not-synced",
            "self._file.finish(sync=sync)",
            "self._file.finish(sync=False)",
            SEGMENTS,
        ),
    ),
    *_of(
        "storage/hybridlog_storage/segments/segment_reader.py",
        (
            "stored-bytes-are-believed",
            "            if crc32(record) != place.crc:\n",
            "            if False:\n",
            SEGMENTS,
        ),
        (
            "indexes-are-believed",
            "        if crc32(trailer) == place.trailer_crc:\n            added",
            "        if True:\n            added",
            SEGMENTS,
        ),
        (
            "metadata-is-believed",
            "        if self.checksum(start, length) != crc:\n",
            "        if False:\n",
            SEGMENTS,
        ),
    ),
    *_of(
        "storage/hybridlog_storage/catalog_parts.py",
        (
            "lines-of-the-catalog-are-believed",
            '        if checksum != b"%08x" % crc32(line):\n',
            "        if False:\n",
            f"{CATALOG}::test_whatever_byte_of_a_part_changes_nothing_wrong_is_said",
        ),
        (
            "a-part-with-fewer-lines-is-whole",
            "is_whole=head.end() + int(head[3]) == len(data)",
            "is_whole=True",
            f"{CATALOG}::test_whatever_is_lost_of_a_part_nothing_wrong_is_said",
        ),
        (
            "parts-of-another-store-are-believed",
            "return head is not None and (head[1], head[2]) !=",
            "return head is not None and (head[1], b'') ==",
            f"{CATALOG}::test_a_part_of_another_catalog_is_removed",
        ),
    ),
    *_of(
        "storage/hybridlog_storage/catalog.py",
        (
            "bounds-of-other-content-are-kept",
            "            if kinds and _content_of(row) != content_of(entry.digests):",
            "            if False:",
            f"{CATALOG}::test_bounds_are_of_one_content",
        ),
        (
            "bounds-are-written-to-other-content",
            "if recording in found and found[recording][0] == known",
            "if recording in found",
            f"{CATALOG}::test_bounds_are_of_one_content",
        ),
        (
            "entries-of-damaged-parts-are-believed",
            "        for number in self._damaged & self._parts.keys():\n",
            "        for number in ():\n",
            f"{CATALOG}::test_whatever_byte_of_a_part_changes_nothing_wrong_is_said",
        ),
        (
            "stamps-are-believed",
            "if digest == entry.digests.get(str(number)) and len(rows)",
            "if len(rows)",
            f"{CATALOG}::test_results_belong_to_one_content_of_a_segment",
        ),
        (
            "chunks-of-another-segment-are-believed",
            "if not (is_ours and is_known):",
            "if False:",
            "tests/test_entries.py::test_chunks_of_another_segment_are_refused",
        ),
    ),
    *_of(
        "storage/hybridlog_storage/mongo/index_state.py",
        (
            "an-index-of-other-segments-is-whole",
            'return self.state == "complete" and dict(self.segments) == entry.digests',
            'return self.state == "complete"',
            "tests/storage/test_index_state.py",
        ),
    ),
    *_of(
        "storage/hybridlog_storage/disk/files.py",
        (
            "symlinks-of-files-are-followed",
            "system.open(path.name, flags | os.O_NOFOLLOW, mode, folder=fd)",
            "system.open(path.name, flags, mode, folder=fd)",
            "tests/storage/test_append_file.py",
        ),
    ),
]
MUTANTS += FORMAT_2

DROPPED = "tests/payloads/test_drop.py"
IMPORT = "tests/payloads/test_import.py"
LATE = "tests/payloads/test_answers.py::test_late_messages_in_row_groups_and_files_of_their_own"
LOST_LINES = f"{DROPPED}::test_a_journal_that_lacks_its_last_lines_loses_no_message"
ODD = "tests/storage/test_journal.py"
POWER = "tests/payloads/test_power_cut.py::test_some_power_cuts"
MARKED = "tests/test_repair.py::test_a_mark_beside_a_lost_segment_takes_nothing_of_it"

MAINTENANCE = [
    *_of(
        "hybridlog/columns/parquet_file.py",
        (
            "late-row-groups-are-in-order",
            "and is_later and order_of(time, seq) is None",
            "and order_of(time, seq) is None",
            LATE,
        ),
    ),
    *_of(
        "hybridlog/columns/payload_writer.py",
        ("columns-are-not-synced", "payloads=payloads, sync=True)", "payloads=payloads)", POWER),
    ),
    *_of(
        "hybridlog/columns/payload_files.py",
        (
            "columns-move-into-folders-that-are-not-synced",
            "            files.sync_folder(recording)\n            files.sync_folder(final)\n",
            "            pass\n",
            POWER,
        ),
        (
            "names-of-columns-are-not-synced",
            "            files.sync_folder(folder)\n",
            "            pass\n",
            POWER,
        ),
    ),
    *_of(
        "hybridlog/maintenance/edit.py",
        (
            "a-mark-takes-the-number-of-a-lost-segment",
            "        numbers.update(inventory.state.sealed if inventory.state is not None else ())\n",
            "",
            MARKED,
        ),
        (
            "a-mark-takes-the-arrival-number-of-a-lost-message",
            "return following + sum(sealed.messages for sealed in inventory.lost)",
            "return following",
            MARKED,
        ),
    ),
    *_of(
        "hybridlog/maintenance/places.py",
        (
            "copied-columns-are-not-checked",
            "open_file(recording / PAYLOADS, self).check()\n",
            "open_file(recording / PAYLOADS, self)\n",
            IMPORT,
        ),
        (
            "more-than-the-listed-bytes-is-copied",
            "fetched = min(at + _FETCHED, end)",
            "fetched = at + _FETCHED",
            f"{IMPORT}::test_only_what_is_listed_is_copied",
        ),
        (
            "what-an-earlier-import-left-stays",
            "                files.remove_tree(path / name)\n",
            "                pass\n",
            f"{IMPORT}::test_what_an_earlier_import_left_is_checked",
        ),
    ),
    *_of(
        "hybridlog/entries.py",
        (
            "a-journal-that-lacked-a-segment-proves",
            "return [journal.event(journal.REBUILT, reason=reason), *new,",
            "return [*new,",
            REPAIR,
        ),
        (
            "a-stripped-segment-needs-its-line",
            "if whole != summary.digest and (sealed is None or sealed.digest == whole):",
            "if state is not None and state.thinned.get(number) and whole != summary.digest:",
            LOST_LINES,
        ),
        (
            "a-stripped-segment-is-listed-like-the-whole-one",
            "return number in state.sealed and is_listed_size and",
            "return number in state.sealed and",
            f"{DROPPED}::test_an_older_journal_in_a_store_that_cannot_be_written",
        ),
        (
            "an-exchanged-stripped-segment-belongs-nowhere",
            "belongs = numbers.get(summary.whole_digest)",
            "belongs = numbers.get(summary.digest)",
            f"{DROPPED}::test_exchanged_segments_that_the_journal_lists_as_whole_ones",
        ),
    ),
    *_of(
        "hybridlog/maintenance/opening.py",
        (
            "what-an-index-has-is-compared-with-entries-that-go",
            "        catalog.drop_damaged()\n",
            "        pass\n",
            "tests/test_catalog_by_hand.py::test_a_line_that_was_lost_is_made_again",
        ),
        (
            "a-question-recovers-what-died",
            "self._refresh(summary.label)",
            "self._mended(summary.label)",
            "tests/test_mending.py::test_a_question_about_a_recorder_that_died_writes_nothing",
        ),
        (
            "what-died-is-not-noted",
            "            self.report.noted.add(label)\n",
            "            pass\n",
            "tests/test_mending.py::test_a_store_that_stays_open_is_repaired_meanwhile",
        ),
        (
            "lost-lines-about-columns-stay-lost",
            "if inventory.stored and (missing := unlisted_lines(inventory)):",
            "if False and (missing := unlisted_lines(inventory)):",
            LOST_LINES,
        ),
    ),
    *_of(
        "hybridlog/columns/topic_table.py",
        (
            "row-groups-that-overlap-are-in-order",
            "if run[-1].last < part.first:",
            "if True:",
            LATE,
        ),
        (
            "the-last-row-of-a-group-begins-no-range",
            "span[0] < high and span[1] > low",
            "span[0] < high - 1 and span[1] > low",
            "tests/tables/test_reader.py::test_row_groups_out_of_range_are_not_read",
        ),
    ),
    *_of(
        "storage/hybridlog_storage/segments/chunk_table.py",
        (
            "a-part-may-end-before-it-begins",
            ' or (parts["first"] > parts["last"]).any()',
            "",
            "tests/storage/test_chunk_table.py",
        ),
    ),
    *_of(
        "storage/hybridlog_storage/journal.py",
        (
            "booleans-are-numbers",
            "if type(value) is not int or",
            "if not isinstance(value, int) or",
            ODD,
        ),
        (
            "labels-lead-elsewhere",
            "(_label(labels[0]), _label(labels[1]))",
            "(_text(labels[0]), _text(labels[1]))",
            ODD,
        ),
        (
            "half-of-a-surrogate-pair-is-text",
            "    value.encode()  # fails for half of a surrogate pair\n",
            "",
            ODD,
        ),
        (
            "the-end-is-taken-as-it-is",
            'self.end = end_of(line["end"])',
            'self.end = dict(line["end"])',
            ODD,
        ),
    ),
]
MUTANTS += MAINTENANCE

OPEN = "tests/storage/test_open_segment.py"
DIFFER = f"{INTERVALS}::test_rows_differ_as_their_values_do"
NOTHING = f"{INTERVALS}::test_nan_equals_nan_and_null_only_null"
CHANGES = "tests/query/test_changes.py"
COMPACT = "tests/payloads/test_compact.py"
DROP = "tests/payloads/test_drop.py"
FOLLOW = "tests/live/test_follow.py"
UNWRITTEN = "tests/live/test_unwritten.py"
LOST = "tests/across/test_lost.py"
DENSITY = "tests/drawing/test_density.py"
SQL_RUNNING = "tests/sql/test_running.py"
NEAR = "tests/across/test_near.py"
RUNNING_ENTRIES = "tests/running/test_entries.py"
CHANGED = f"{SNAPSHOT}::test_a_recording_that_has_changed_is_as_if_it_had_been_so"
CHOSEN = f"{IDENTITY}::test_a_command_changes_the_recording_that_was_chosen"
COVERED = f"{INTERVALS}::test_intervals_cover_what_sets_of_times_do"
HELD = f"{INTERVALS}::test_a_state_holds_until_the_next_message"
STEPS_NEAR = f"{INTERVALS}::test_steps_that_are_near_are_one_change"

SILENT = [
    *_of(
        "storage/hybridlog_storage/segments/open_segment.py",
        (
            "a-segment-that-was-taken-back-is-not-read-anew",
            "        is_cut = self.is_cut()\n",
            "        is_cut = False\n",
            OPEN,
        ),
        (
            "another-chunk-in-the-place-of-one-is-not-noticed",
            "        return bytes(self.reader.read(self._chunks[-1][0], CHUNK_HEAD.size)) != self._last\n",
            "        return False\n",
            OPEN,
        ),
        (
            "what-no-writer-leaves-is-the-end",
            '                        self.stopped = Damage(at, size - at, "there is no whole record")\n',
            "                        pass\n",
            OPEN,
        ),
        (
            "a-channel-that-is-not-defined-is-believed",
            "        if not is_known.all():\n",
            "        if False:\n",
            OPEN,
        ),
        (
            "a-record-that-is-being-written-counts",
            "if behind > size or not self._take(",
            "if not self._take(",
            OPEN,
        ),
        (
            "flushed-indexes-are-believed",
            "        if crc32(trailer) == trailer_crc:\n",
            "        if True:\n",
            OPEN,
        ),
        (
            "unreadable-flushed-chunks-are-no-damage",
            "            self.damaged.append(Damage(offset, length, str(error)))\n",
            "            pass\n",
            OPEN,
        ),
        (
            "flushed-definitions-are-believed",
            "            if start < 0 or self.reader.checksum(start, proof.length) != proof.before:\n",
            "            if start < 0:\n",
            OPEN,
        ),
        (
            "unreadable-flushed-records-are-no-damage",
            "                self.damaged.append(Damage(at, behind - at, str(error)))\n",
            "                pass\n",
            OPEN,
        ),
        (
            "flushed-losses-are-dropped",
            "            self.losses += loss_rows(json_of(record))\n",
            "            pass\n",
            OPEN,
        ),
        (
            "our-flushed-metadata-is-that-of-the-source",
            "        elif not record.name.startswith(OUR_NAMES):\n",
            "        else:\n",
            OPEN,
        ),
        (
            "flushed-attachments-are-dropped",
            "        self._attachments.append(found.index(at, length))\n",
            "",
            OPEN,
        ),
        (
            "heads-of-flushed-messages-are-payload",
            " - MESSAGE_HEAD.itemsize",
            "",
            OPEN,
        ),
        (
            "a-table-that-was-asked-for-never-grows",
            "        self._last = self._head[: CHUNK_HEAD.size]\n        self._flushed = None\n",
            "        self._last = self._head[: CHUNK_HEAD.size]\n",
            OPEN,
        ),
        (
            "a-record-that-was-flushed-later-is-not-seen",
            "self.reader.checksum(at, length)))\n        self._flushed = None\n",
            "self.reader.checksum(at, length)))\n",
            OPEN,
        ),
        (
            "the-last-time-of-an-index-is-its-first",
            "[t[0] for t in times], [t[-1] for t in times]",
            "[t[0] for t in times], [t[0] for t in times]",
            OPEN,
        ),
        (
            "order-of-flushed-messages-is-taken-for-granted",
            "    sizes[order] = np.diff(starts[order], ",
            "    sizes[:] = np.diff(starts, ",
            OPEN,
        ),
    ),
    *_of(
        "hybridlog/snapshot.py",
        (
            "a-recording-that-has-begun-keeps-its-place",
            "bisect_left(found.summaries, _order(one), key=_order) for",
            "len(found.summaries) for",
            CHANGED,
        ),
        (
            "a-recording-that-was-renamed-keeps-its-label",
            "        if before == places[::-1] and [one.label for one in changed] == [\n"
            "            self.summaries[place].label for place in before\n        ]:\n",
            "        if before == places[::-1]:\n",
            CHANGED,
        ),
        (
            "a-recording-that-goes-on-has-two-places",
            "np.insert(np.delete(self._columns[name], places), before, values)",
            "np.insert(self._columns[name], before, values)",
            CHANGED,
        ),
        (
            "a-moment-before-is-changed-too",
            "        found.summaries = self.summaries.copy()\n",
            "",
            CHANGED,
        ),
        (
            "new-tags-are-not-found",
            '            stale = {"tags", "unfinished"}  # each',
            '            stale = {"unfinished"}  # each',
            CHANGED,
        ),
        (
            "a-new-topic-has-no-recordings",
            "_topics=known, _having={})",
            "_topics=known)",
            CHANGED,
        ),
        (
            "a-new-topic-is-not-listed",
            'stale |= {"topics", "schemas"}',
            'stale |= {"schemas"}',
            CHANGED,
        ),
        (
            "a-new-topic-is-that-of-another-recording",
            '            columns["set"] = np.searchsorted(used, columns["set"])\n',
            "",
            CHANGED,
        ),
    ),
    *_of(
        "hybridlog/query/intervals.py",
        (
            "intervals-that-touch-stay-apart",
            "rows[1:, 0] > reach[:-1]]",
            "rows[1:, 0] >= reach[:-1]]",
            COVERED,
        ),
        (
            "an-interval-ends-with-the-last-inside-it",
            "    reach = np.maximum.accumulate(rows[:, 1])\n",
            "    reach = rows[:, 1]\n",
            COVERED,
        ),
        (
            "what-is-behind-the-last-taken-is-dropped",
            "            end = np.concatenate([taken[:, 0], [END]])\n            rows =",
            "            end = np.concatenate([taken[:, 0], taken[-1:, 1]])\n            begin = begin[: len(end)]\n            rows =",
            f"{NEAR}::test_union_and_difference",
        ),
        (
            "a-change-ends-with-its-pause",
            "(rows[:-1, 1] - 1) > self._pause",
            "(rows[:-1, 1] - 1) >= self._pause",
            STEPS_NEAR,
        ),
        (
            "an-open-change-is-a-nanosecond-longer",
            "        apart = rows[1:, 0] - (rows[:-1, 1] - 1) > self._pause\n",
            "        apart = rows[1:, 0] - rows[:-1, 1] > self._pause\n",
            STEPS_NEAR,
        ),
        (
            "the-first-of-messages-at-a-time-counts",
            "axis=1)[holds[last]]",
            "axis=1)[holds[first]]",
            HELD,
        ),
        (
            "a-block-ends-with-its-last-time",
            "whole = int(np.searchsorted(time, time[-1])) if len(time) else 0",
            'whole = int(np.searchsorted(time, time[-1], "right")) if len(time) else 0',
            HELD,
        ),
        (
            "messages-that-end-a-state-count",
            "            count[len(self._count) :] = holds[len(self._count) :]\n",
            "            count[len(self._count) :] = 1\n",
            HELD,
        ),
    ),
    *_of(
        "hybridlog/maintenance/edit.py",
        (
            "the-recording-that-has-the-label-is-edited",
            "    with directory.writing(entry.label, entry.id, wait_s=LOCK_WAIT_S) as label:\n        directory.append",
            "    with directory.writing(entry.label, wait_s=LOCK_WAIT_S) as label:\n        directory.append",
            f"{CHOSEN}[tag-3]",
        ),
        (
            "the-recording-that-has-the-label-is-marked",
            "    with directory.writing(entry.label, entry.id, wait_s=LOCK_WAIT_S) as label:\n        with directory.at_hand(label) as here:\n            path",
            "    with directory.writing(entry.label, wait_s=LOCK_WAIT_S) as label:\n        with directory.at_hand(label) as here:\n            path",
            f"{CHOSEN}[mark-3]",
        ),
    ),
    *_of(
        "hybridlog/maintenance/edit.py",
        (
            "the-recording-that-has-the-label-is-removed",
            "    with directory.writing(entry.label, entry.id, wait_s=LOCK_WAIT_S) as label:\n"
            "        if isinstance(directory, RemoteDirectory):\n",
            "    with directory.writing(entry.label, wait_s=LOCK_WAIT_S) as label:\n"
            "        if isinstance(directory, RemoteDirectory):\n",
            f"{CHOSEN}[rm-3]",
        ),
        (
            "the-last-copy-is-removed-as-a-copy",
            "        if now != label or directory.labels_of(recording) == [label]:\n",
            "        if now != label:\n",
            f"{IDENTITY}::test_a_copy_is_removed_only_while_it_is_one",
        ),
    ),
    *_of(
        "hybridlog/maintenance/compact.py",
        (
            "the-recording-that-has-the-label-is-compacted",
            "    with directory.writing(entry.label, entry.id, wait_s=LOCK_WAIT_S) as label:\n",
            "    with directory.writing(entry.label, wait_s=LOCK_WAIT_S) as label:\n",
            f"{CHOSEN}[compact-3]",
        ),
    ),
    *_of(
        "hybridlog/query/answers/follow.py",
        (
            "what-was-followed-comes-again",
            "(read if segment == last else 0)",
            "0",
            f"{FOLLOW}::test_each_message_comes_once_whenever_it_was_sent",
        ),
        (
            "following-begins-with-the-segment",
            "                _ = [*self._arrivals(entry, None)]\n",
            "",
            f"{FOLLOW}::test_each_message_comes_once_whenever_it_was_sent",
        ),
        (
            "the-rest-of-a-sealed-segment-is-not-followed",
            "- {*range(last)})",
            "- {*range(last + (last in map(int, entry.digests)))})",
            f"{FOLLOW}::test_each_message_comes_once_whenever_it_was_sent",
        ),
        (
            "following-takes-topics-that-nobody-named",
            "(*self.question.topics, *filter(self._takes, new))",
            "(*self.question.topics, *new)",
            f"{FOLLOW}::test_globs_take_topics_that_appear_later",
        ),
        (
            "an-end-that-moves-is-an-end",
            '(word.startswith("-"), f"has no end',
            '(False, f"has no end',
            f"{FOLLOW}::test_what_has_no_end_yet_is_refused",
        ),
    ),
    *_of(
        "hybridlog/query/answers/lost.py",
        (
            "the-last-message-is-behind-the-last-flush",
            "return end > (begin if",
            "return end >= (begin if",
            UNWRITTEN,
        ),
        (
            "all-times-reach-past-the-last-flush",
            "end = min(end, int(windows[-1, 1])) if len(windows) else begin",
            "pass",
            UNWRITTEN,
        ),
        (
            "what-nobody-knows-is-nothing",
            "            missing = None\n",
            "            pass\n",
            UNWRITTEN,
        ),
        (
            "unwritten-messages-of-all-topics-count",
            "sum(late.get(topic, 0) for topic in owners)",
            "sum(late.values())",
            UNWRITTEN,
        ),
        (
            "losses-of-all-topics-count",
            'row["topic"] not in question.topics:',
            "False:",
            LOST,
        ),
        (
            "a-loss-is-as-long-as-its-range",
            "((chosen[:, 0] <= span[1]) & (span[0] < chosen[:, 1]))",
            "(span[0] < chosen[:, 1])",
            LOST,
        ),
        (
            "the-end-of-a-range-is-in-it",
            "(span[0] < chosen[:, 1])",
            "(span[0] <= chosen[:, 1])",
            LOST,
        ),
        (
            "times-are-lost-in-no-time",
            "chosen = np.array([[BEGIN, END]], np.int64) if windows is None else windows",
            "chosen = np.array([[BEGIN, END]], np.int64)",
            LOST,
        ),
    ),
    *_of(
        "hybridlog/query/chunk_columns.py",
        (
            "a-chunk-that-touches-a-range-is-left-out",
            '(own[f"last{suffix}"] >= begin)',
            '(own[f"last{suffix}"] > begin)',
            f"{CATALOG}::test_chunks_by_channel_time_and_clock",
        ),
    ),
    *_of(
        "hybridlog/query/chunk_counts.py",
        (
            "chunks-that-were-flushed-later-have-other-numbers",
            "np.repeat(np.arange(known, len(counts)), counts[known:])",
            "np.repeat(np.arange(len(counts) - known), counts[known:])",
            DENSITY,
        ),
        (
            "chunks-are-counted-each-time-they-are-looked-for",
            "parts = table.parts[int(counts[:known].sum()) :]",
            "parts = table.parts[known:]",
            DENSITY,
        ),
    ),
    *_of(
        "hybridlog/drawing/chunk_parts.py",
        (
            "a-segment-is-read-up-to-what-was-flushed",
            "            if not table.is_flushed:\n",
            "            if True:\n",
            DENSITY,
        ),
        (
            "another-sealed-segment-of-the-same-number-is-the-same",
            "before.digests.get(number) in {None, recording.digests.get(number)}",
            "True",
            DENSITY,
        ),
        (
            "another-chunk-of-the-same-place-is-the-same",
            'for name in ("offset", "length", "trailer_crc")',
            'for name in ("offset",)',
            DENSITY,
        ),
        (
            "a-part-that-ends-when-a-span-begins-is-left-out",
            "(rows[:, 5] >= span[0])",
            "(rows[:, 5] > span[0])",
            DENSITY,
        ),
        (
            "a-segment-that-ends-when-a-span-begins-is-left-out",
            "or last < span[0]:",
            "or last <= span[0]:",
            DENSITY,
        ),
    ),
    *_of(
        "hybridlog/columns/tables.py",
        (
            "tables-with-other-rows-than-segments-are-believed",
            "if table is None or table.rows != sum(messages.get(number, 0) for number in segments):\n",
            "if table is None:\n",
            f"{SQL_RUNNING}::test_sealed_segments_answer_from_tables",
        ),
    ),
    *_of(
        "hybridlog/record/running.py",
        (
            "flushed-messages-count-as-sealed-ones",
            "channels = {channel.id: replace(channel) for channel in sealed.channels}",
            "channels = {channel.id: channel for channel in sealed.channels}",
            RUNNING_ENTRIES,
        ),
        (
            "spans-of-flushed-segments-pile-up",
            "found = replace(sealed, end=dict(sealed.end), spans=list(sealed.spans))",
            "found = replace(sealed, end=dict(sealed.end))",
            RUNNING_ENTRIES,
        ),
        (
            "a-segment-that-is-listed-and-sealed-counts-twice",
            "            if str(number) in self._sealed.digests:\n                continue\n",
            "",
            RUNNING_ENTRIES,
        ),
        (
            "an-unreadable-open-segment-is-no-loss",
            "            self._unreadable[number] = str(error)\n",
            "            pass\n",
            RUNNING_ENTRIES,
        ),
        (
            "damage-of-an-open-segment-is-no-loss",
            "            yield _damaged(number, damage.reason, damage.offset, damage.length)\n",
            "            pass\n",
            RUNNING_ENTRIES,
        ),
    ),
    *_of(
        "hybridlog/query/rows_differ.py",
        (
            "nan-differs-from-nan",
            "        same |= np.isnan(left) & np.isnan(right)\n",
            "        pass\n",
            NOTHING,
        ),
        (
            "null-is-what-stands-in-its-place",
            "valid[one] != valid[other]\n",
            "np.zeros(len(one), np.bool_)\n",
            NOTHING,
        ),
        (
            "a-list-that-begins-alike-is-the-same",
            "found: NDArray[np.bool_] = count != length[other]",
            "found: NDArray[np.bool_] = count > length[other]",
            DIFFER,
        ),
        (
            "a-missing-field-is-null",
            "m.get(path[0], _MISSING) if isinstance",
            "m.get(path[0]) if isinstance",
            f"{CHANGES}::test_null_and_missing_are_different",
        ),
        (
            "true-is-the-number-one",
            "return type(one) is type(other) and one == other",
            "return one == other",
            CHANGES,
        ),
        (
            "a-tolerance-is-exclusive",
            "<= tolerance\n        return near",
            "< tolerance\n        return near",
            CHANGES,
        ),
    ),
    *_of(
        "hybridlog/maintenance/compact.py",
        (
            "columns-of-other-bytes-are-believed",
            "    if any(content[a:b] != data[c:d] for a, b, (c, d) in pieces):\n",
            "    if False:\n",
            f"{COMPACT}::test_a_proof_that_fails_leaves_nothing",
        ),
        (
            "columns-of-other-arrival-numbers-are-believed",
            "        (rebuilt.seq[inside] == chunk.seq[rows]).all()\n        and ",
            "        ",
            f"{COMPACT}::test_columns_with_other_arrival_numbers_are_refused",
        ),
    ),
    *_of(
        "hybridlog/maintenance/thinning.py",
        (
            "chunks-of-topics-that-were-not-named-are-taken-out",
            "        in_columns &= set(topics)\n",
            "        pass\n",
            f"{DROP}::test_only_chunks_of_the_named_topics_are_taken_out",
        ),
        (
            "chunks-that-do-not-come-back-are-taken-out",
            '        if memoryview(rebuilt).cast("B") == content:\n',
            "        if True:\n",
            DROP,
        ),
        (
            "a-new-segment-is-believed",
            "    if not is_same:\n",
            "    if False:\n",
            DROP,
        ),
    ),
]
MUTANTS += SILENT

#!/usr/bin/env python3
"""Read a recording with the public `mcap` package (pip install mcap; numpy for --npz).

    read_recording.py LOG.mcap                  streams, channels, rates and the first rows
    read_recording.py LOG.mcap --npz LOG.npz    arrays STREAM/time (s) and STREAM/CHANNEL; no sample is NaN

To import: `streams(path)` gives {stream: (channels, rate_hz, times in s, rows)}; a number without sample is None.
"""
import argparse
import json
import sys

from mcap.reader import make_reader


def metadata(path):
    """What is known of the recording as a whole, as text by key."""
    with open(path, "rb") as file:
        for record in make_reader(file).iter_metadata():
            if record.name == "recording":
                return record.metadata
    return {}


def streams(path):
    """{stream: (channels, nominal rate in Hz or None, times in s, rows)}"""
    zero = int(metadata(path).get("zero_ns", 0))
    found = {}
    with open(path, "rb") as file:
        reader = make_reader(file)
        for topic in reader.get_summary().channels.values():
            if topic.message_encoding == "json" and "channels" in topic.metadata:
                rate = topic.metadata.get("rate_hz")
                found[topic.topic] = (json.loads(topic.metadata["channels"]), rate and float(rate), [], [])
        for _, topic, message in reader.iter_messages(topics=list(found)):
            _, _, times, rows = found[topic.topic]
            times.append((message.log_time - zero) * 1e-9)
            rows.append(json.loads(message.data)["values"])
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", metavar="LOG.mcap")
    parser.add_argument("--rows", type=int, default=3, metavar="N", help="rows of each stream to print [3]")
    parser.add_argument("--npz", metavar="OUT.npz", help="write the numbers for NumPy")
    args = parser.parse_args()
    found = streams(args.recording)
    for key, value in metadata(args.recording).items():
        print(f"{key}: {value}")
    for name, (channels, rate, times, rows) in found.items():
        print(f"{name}: {len(rows)} samples, {rate or 'no nominal'} Hz")
        for channel in channels:
            print(f"    {channel['kind']} {channel['name']} {channel['unit']}".rstrip())
        for time, row in list(zip(times, rows))[: args.rows]:
            print(f"    {time:.9f} s: {row}")
    if args.npz:
        import numpy as np

        arrays = {}
        for name, (channels, _, times, rows) in found.items():
            values = np.array(rows, dtype=float).reshape(len(rows), len(channels))
            arrays[f"{name}/time"] = np.array(times)
            for column, channel in enumerate(channels):
                arrays[f"{name}/{channel['name']}"] = values[:, column]
        np.savez(args.npz, **arrays)


if __name__ == "__main__":
    sys.exit(main())

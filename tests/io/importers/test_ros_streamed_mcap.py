"""MCAP files without an index, cut off or empty: what is read from their beginning."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rosbags")
from ros_writers import BagWriter, write_camera

from femsense.core.errors import InputError
from femsense.io.importers.ros.bag import open_bag
from femsense.io.importers.ros.streamed_mcap import StreamedMcap


def test_a_whole_file_gives_the_messages_of_rosbags(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        write_camera(bag, 20)
    file = tmp_path / "take/take.mcap"
    streamed = StreamedMcap(file)
    with open_bag(file) as whole:
        topics = {t.name: (t.type, t.count) for t in whole.topics}
        assert {c.topic: (c.msgtype, c.msgcount) for c in streamed.connections} == topics
        mine = sorted((at, c.topic, raw) for c, at, raw in streamed.messages(streamed.connections))
        theirs = sorted((round(1e9 * m.record), m.topic, m.raw) for m in whole.messages(list(topics)))
        assert [(t, r) for _, t, r in mine] == [(t, r) for _, t, r in theirs]
        image = next(raw for _, topic, raw in mine if topic == "/camera/color/image_raw")
        assert streamed.deserialize(image, "sensor_msgs/msg/Image").encoding == "rgb8"


def test_nothing_whole_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(InputError, match="without a whole message"):
        StreamedMcap(tmp_path / "a.mcap")


@pytest.mark.parametrize("compression", ["NONE", "ZSTD", "LZ4"])
def test_a_file_that_was_cut_off_gives_its_whole_chunks(compression: str, tmp_path: Path) -> None:
    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    with BagWriter(tmp_path / "take", "mcap") as bag:
        write_camera(bag, 20)
    kinds, channels = {}, {}
    with (tmp_path / "take/take.mcap").open("rb") as source, (tmp_path / "one.mcap").open("wb") as sink:
        writer = Writer(sink, compression=CompressionType[compression], chunk_size=1 << 15)
        writer.start(profile="ros2")
        for schema, channel, message in make_reader(source).iter_messages():
            if channel.topic not in channels:
                assert schema is not None
                kinds[channel.topic] = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", kinds[channel.topic])
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
        writer.finish()
    data = (tmp_path / "one.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: int(0.7 * len(data))])
    whole, cut = StreamedMcap(tmp_path / "one.mcap"), StreamedMcap(tmp_path / "cut.mcap")
    assert 0.2 * whole.count < cut.count < whole.count
    for mine, theirs in zip(cut.messages(cut.connections), whole.messages(whole.connections)):
        assert (mine[0].topic, mine[1], mine[2]) == (theirs[0].topic, theirs[1], theirs[2])


def test_a_folder_whose_metadata_is_broken(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        write_camera(bag, 2)
    (tmp_path / "take/metadata.yaml").write_text("rosbag2_bagfile_information: [1,")
    with pytest.warns(UserWarning, match="metadata.yaml is broken"), open_bag(tmp_path / "take") as read:
        assert any(topic.count == 2 for topic in read.topics)

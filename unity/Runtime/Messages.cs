// The bytes of a stream (docs/guides/streaming.md), and the only place where frames of reference are converted. Needs no Unity.
using System;
using System.Collections.Generic;
using System.Globalization;
using System.Text;
using System.Text.RegularExpressions;

namespace Femsense
{
    /// <summary>A payload for a topic.</summary>
    public struct Message
    {
        public string Topic;
        public byte[] Payload;
    }

    /// <summary>Bones of a robot at one time; right-handed robot frame, metres.</summary>
    public sealed class Pose
    {
        public uint Seq;
        public double TimeS;
        /// <summary>x y z qx qy qz qw of each bone.</summary>
        public float[] Bones;

        public int Count { get { return Bones.Length / 7; } }

        /// <summary>Returns the pose in a message, or null where it holds none.</summary>
        public static Pose Read(byte[] payload)
        {
            if (payload.Length < 20 || Encoding.ASCII.GetString(payload, 0, 4) != "FSP1") return null;
            int count = BitConverter.ToUInt16(payload, 16);
            if (payload.Length != 20 + 28 * count) return null;
            var pose = new Pose { Seq = BitConverter.ToUInt32(payload, 4), TimeS = BitConverter.ToDouble(payload, 8), Bones = new float[7 * count] };
            Buffer.BlockCopy(payload, 20, pose.Bones, 0, 28 * count);
            return pose;
        }
    }

    /// <summary>Values of a flat JSON object, or of the top of a nested one where the name is not in it again.</summary>
    public static class Document
    {
        /// <summary>Returns the text under a name, or null where there is none.</summary>
        public static string Text(byte[] payload, string name)
        {
            var found = Regex.Match(Encoding.UTF8.GetString(payload), "\"" + name + "\"\\s*:\\s*\"((?:[^\"\\\\]|\\\\.)*)\"");
            return found.Success ? Regex.Unescape(found.Groups[1].Value) : null;
        }

        /// <summary>Returns the number under a name, or NaN where there is none.</summary>
        public static double Number(byte[] payload, string name)
        {
            var found = Regex.Match(Encoding.UTF8.GetString(payload), "\"" + name + "\"\\s*:\\s*(-?[0-9][0-9.eE+-]*)");
            double value;
            return found.Success && double.TryParse(found.Groups[1].Value, NumberStyles.Float, CultureInfo.InvariantCulture, out value) ? value : double.NaN;
        }
    }

    /// <summary>Whether a robot streams: waiting (for what Detail says), live, stale (its sensors say nothing), ended, or lost (its program died).</summary>
    public sealed class Status
    {
        public string State = "";
        public string Detail = "";
        /// <summary>When the last pose went out, by the sender's clock [s since 1970]; NaN where it is not said.</summary>
        public double SinceS = double.NaN;

        /// <summary>Whether what is shown is old, however late it was received.</summary>
        public bool IsOld { get { return State == "stale" || State == "ended" || State == "lost"; } }

        /// <summary>Returns the status in a message, or null where it holds none.</summary>
        public static Status Read(byte[] payload)
        {
            var state = Document.Text(payload, "state");
            if (state == null) return null;
            return new Status { State = state, Detail = Document.Text(payload, "detail") ?? "", SinceS = Document.Number(payload, "since_s") };
        }
    }

    /// <summary>An answer to a drag: "converging" while nearer ones follow by themselves; reached, nearest or stopped is the end.</summary>
    public sealed class Reach
    {
        public string Status = "";
        public string Text = "";
        public double ErrorM = double.NaN;

        public bool IsFinal { get { return Status != "converging"; } }

        /// <summary>Returns the answer in a message, or null where it holds none.</summary>
        public static Reach Read(byte[] payload)
        {
            var status = Document.Text(payload, "status");
            if (status == null) return null;
            return new Reach { Status = status, Text = Document.Text(payload, "text") ?? "", ErrorM = Document.Number(payload, "error_m") };
        }
    }

    /// <summary>From the right-handed robot frame to Unity's left-handed one, under a transform turned by -90 degrees about x.</summary>
    public static class Frame
    {
        /// <summary>A mirror image at x = 0, as glTF importers make it: apply to places and directions.</summary>
        public static void Place(float x, float y, float z, float[] into)
        {
            into[0] = -x;
            into[1] = y;
            into[2] = z;
        }

        /// <summary>The same for a rotation x y z w.</summary>
        public static void Turn(float x, float y, float z, float w, float[] into)
        {
            into[0] = x;
            into[1] = -y;
            into[2] = -z;
            into[3] = w;
        }
    }

    /// <summary>Frames of the WebSocket: topic length uint16, payload length uint32, topic, payload, again and again.</summary>
    public static class Frames
    {
        /// <summary>Returns a frame of one message.</summary>
        public static byte[] Write(string topic, byte[] payload)
        {
            var name = Encoding.UTF8.GetBytes(topic);
            var frame = new byte[6 + name.Length + payload.Length];
            BitConverter.GetBytes((ushort)name.Length).CopyTo(frame, 0);
            BitConverter.GetBytes((uint)payload.Length).CopyTo(frame, 2);
            name.CopyTo(frame, 6);
            payload.CopyTo(frame, 6 + name.Length);
            return frame;
        }

        public static List<Message> Read(byte[] frame, int length)
        {
            var found = new List<Message>();
            int at = 0;
            while (at + 6 <= length)
            {
                int name = BitConverter.ToUInt16(frame, at);
                long size = BitConverter.ToUInt32(frame, at + 2);
                if (at + 6 + name + size > length) break;
                var payload = new byte[size];
                Buffer.BlockCopy(frame, at + 6 + name, payload, 0, (int)size);
                found.Add(new Message { Topic = Encoding.UTF8.GetString(frame, at + 6, name), Payload = payload });
                at += 6 + name + (int)size;
            }
            return found;
        }
    }
}

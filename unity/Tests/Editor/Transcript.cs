// Checks Messages.cs against a transcript that Python wrote: each line is bytes in hexadecimal and what is in them.
using System;
using System.Globalization;
using System.IO;
using System.Linq;

namespace Femsense
{
    public static class Transcript
    {
        /// <summary>Returns 0 where every line of a file is read as it says; says the first that is not.</summary>
        public static int Run(string file)
        {
            int checkedLines = 0;
            foreach (var line in File.ReadAllLines(file))
            {
                var parts = line.Split(' ');
                var frame = Enumerable.Range(0, parts[0].Length / 2).Select(i => Convert.ToByte(parts[0].Substring(2 * i, 2), 16)).ToArray();
                if (parts.Length > 2 && parts[2].Contains("="))
                {
                    var document = Frames.Read(frame, frame.Length).Single();
                    if (document.Topic != parts[1] || !Said(document).SequenceEqual(parts.Skip(2))) return Fail(line, string.Join(" ", Said(document)));
                    checkedLines++;
                    continue;
                }
                var wanted = parts.Skip(2).Select(p => double.Parse(p, CultureInfo.InvariantCulture)).ToArray();
                var messages = Frames.Read(frame, frame.Length);
                if (messages.Count != 1 || messages[0].Topic != parts[1]) return Fail(line, "topic");
                if (!Frames.Write(parts[1], messages[0].Payload).SequenceEqual(frame)) return Fail(line, "written");
                var pose = Pose.Read(messages[0].Payload);
                if (wanted.Length == 0)
                {
                    if (pose != null) return Fail(line, "no pose");
                }
                else if (pose == null || !Same(Numbers(pose), wanted)) return Fail(line, "numbers");
                checkedLines++;
            }
            Console.WriteLine(checkedLines + " lines agree");
            return 0;
        }

        /// <summary>seq, time, then the bones in Unity's frame.</summary>
        private static double[] Numbers(Pose pose)
        {
            var found = new double[2 + pose.Bones.Length];
            found[0] = pose.Seq;
            found[1] = pose.TimeS;
            var place = new float[3];
            var turn = new float[4];
            for (int b = 0; b < pose.Count; b++)
            {
                var v = pose.Bones;
                int i = 7 * b;
                Frame.Place(v[i], v[i + 1], v[i + 2], place);
                Frame.Turn(v[i + 3], v[i + 4], v[i + 5], v[i + 6], turn);
                for (int k = 0; k < 3; k++) found[2 + i + k] = place[k];
                for (int k = 0; k < 4; k++) found[5 + i + k] = turn[k];
            }
            return found;
        }

        /// <summary>What a status or an answer to a drag says, with _ for blanks.</summary>
        private static string[] Said(Message message)
        {
            if (message.Topic.EndsWith("/reach"))
            {
                var reach = Reach.Read(message.Payload);
                return new[] { "status=" + reach.Status, "final=" + reach.IsFinal, "text=" + reach.Text.Replace(' ', '_'), "error_m=" + Number(reach.ErrorM) };
            }
            if (message.Topic.EndsWith("/force")) return new[] { "status=" + Document.Text(message.Payload, "status").Replace(' ', '_') };
            var status = Status.Read(message.Payload);
            return new[] { "state=" + status.State, "old=" + status.IsOld, "detail=" + status.Detail.Replace(' ', '_'), "since_s=" + Number(status.SinceS) };
        }

        private static string Number(double value)
        {
            return value.ToString("R", CultureInfo.InvariantCulture);
        }

        private static bool Same(double[] a, double[] b)
        {
            return a.Length == b.Length && Enumerable.Range(0, a.Length).All(i => Math.Abs(a[i] - b[i]) < 1e-6);
        }

        private static int Fail(string line, string what)
        {
            Console.WriteLine(what + ": " + line);
            return 1;
        }
    }
}

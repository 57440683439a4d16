// The transcript in Unity's test runner; mono runs the same check by Tests~/Program.cs.
using System.IO;
using NUnit.Framework;

namespace Femsense
{
    public sealed class TranscriptTests
    {
        [Test]
        public void WhatPythonWroteIsRead()
        {
            Assert.AreEqual(0, Transcript.Run(Path.GetFullPath("Packages/org.femsense.stream/Tests/Editor/transcript.txt")));
        }
    }
}

// The transcript without Unity:
// mcs -out:transcript.exe unity/Runtime/Messages.cs unity/Tests/Editor/Transcript.cs unity/Tests~/Program.cs
// mono transcript.exe unity/Tests/Editor/transcript.txt
namespace Femsense
{
    public static class Program
    {
        public static int Main(string[] arguments)
        {
            return Transcript.Run(arguments[0]);
        }
    }
}

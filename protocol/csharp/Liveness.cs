// Whether another process lives, told by its pid and the time it was started: a pid alone is used again.

using System;
using System.ComponentModel;
using System.Diagnostics;
using System.Globalization;
using System.IO;

namespace TubeCosim
{
    public static class Liveness
    {
        private static readonly bool HasProc = File.Exists("/proc/self/stat");

        // Indices into the fields of /proc/PID/stat behind the command's name, which may hold spaces and brackets.
        private const int StateField = 0;
        private const int StartTimeField = 19;

        // Identity of this process as it stands in a header.
        public static void Self(out long pid, out long startTime)
        {
            using (Process process = Process.GetCurrentProcess())
                pid = process.Id;
            startTime = StartTime(pid);
        }

        // Linux: clock ticks since boot; Windows: creation time (100 ns since 1601); 0 where it is not known.
        public static long StartTime(long pid)
        {
            if (HasProc)
            {
                string[] stat = ProcStat(pid);
                return stat == null ? 0 : long.Parse(stat[StartTimeField], CultureInfo.InvariantCulture);
            }
            try
            {
                using (Process process = Process.GetProcessById((int)pid))
                    return Segment.OnWindows ? process.StartTime.ToFileTimeUtc() : 0;
            }
            catch (Exception error) when (IsAboutProcesses(error))
            {
                return 0;
            }
        }

        // A zombie is dead; a process that may not be asked lives; a pid of 0 or less names no process and lives.
        public static bool IsDead(long pid, long startTime)
        {
            if (pid <= 0)
                return false;
            if (pid > int.MaxValue)
                return true;
            return HasProc ? IsDeadInProc(pid, startTime) : IsDeadElsewhere((int)pid, startTime);
        }

        private static bool IsDeadInProc(long pid, long startTime)
        {
            string[] stat = ProcStat(pid);
            if (stat == null || "ZXx".Contains(stat[StateField]))
                return true;
            return startTime != 0 && stat[StartTimeField] != startTime.ToString(CultureInfo.InvariantCulture);
        }

        private static bool IsDeadElsewhere(int pid, long startTime)
        {
            try
            {
                using (Process process = Process.GetProcessById(pid))
                {
                    if (process.HasExited)
                        return true;
                    return Segment.OnWindows && startTime != 0
                        && process.StartTime.ToFileTimeUtc() != startTime;
                }
            }
            catch (ArgumentException)
            {
                return true; // there is no such process
            }
            catch (Exception error) when (IsAboutProcesses(error))
            {
                return false; // it exists and may not be asked
            }
        }

        private static bool IsAboutProcesses(Exception error)
        {
            return error is ArgumentException || error is InvalidOperationException || error is Win32Exception
                || error is NotSupportedException;
        }

        // The fields behind the command's name, or null where there is no such process.
        private static string[] ProcStat(long pid)
        {
            string text;
            try
            {
                using (StreamReader reader = new StreamReader("/proc/" + Format.Of(pid) + "/stat"))
                    text = reader.ReadToEnd();
            }
            catch (IOException)
            {
                return null; // also where it ended between opening and reading
            }
            int behindName = text.LastIndexOf(')') + 2;
            return behindName < 2 ? null : text.Substring(behindName).Split(' ');
        }
    }
}

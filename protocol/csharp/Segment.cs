// One mapped segment: words, texts, the lock of its one writer, and its name.
//
// Safe code throughout (no `unsafe`, no box to tick in Unity): words go through Marshal on the mapping's address,
// which is one aligned 8-byte access, and fences through Thread.MemoryBarrier, which also keeps the compiler from
// moving or dropping an access. Acquire and Release are what Volatile.Read and Volatile.Write do for a variable.

using System;
using System.Diagnostics;
using System.IO;
using System.IO.MemoryMappedFiles;
using System.Runtime.InteropServices;
using System.Text;
using System.Threading;

namespace TubeCosim
{
    // Where the two sides meet: shm:NAME or file:/path/stem.
    public sealed class Rendezvous
    {
        private const string ShmFolder = "/dev/shm";
        private readonly string text;

        public readonly bool Named; // Windows' named mappings, which have no path
        public readonly string Stem; // name of the mappings, or path of the files, both without suffix

        private Rendezvous(string text, bool named, string stem)
        {
            this.text = text;
            Named = named;
            Stem = stem;
        }

        // Throws ProtocolException where the text is neither, or names what this system does not offer.
        public static Rendezvous Parse(string text)
        {
            if (text.StartsWith("shm:", StringComparison.Ordinal))
            {
                string name = text.Substring(4);
                if (!IsName(name))
                    throw Unusable(text, "shm:NAME with 1 to 64 of A-Z a-z 0-9 . _ -, the first a letter or digit");
                if (Segment.OnWindows)
                    return new Rendezvous(text, true, name);
                if (!Directory.Exists(ShmFolder))
                    throw Unusable(text, "file:/path/stem, since this system has no " + ShmFolder);
                return new Rendezvous(text, false, ShmFolder + "/" + name);
            }
            if (text.StartsWith("file:", StringComparison.Ordinal))
            {
                string stem = text.Substring(5);
                if (stem.IndexOf('\0') >= 0 || !IsAbsolute(stem) || Path.GetFileName(stem).Length == 0)
                    throw Unusable(text, "file: and an absolute path without suffix");
                return new Rendezvous(text, false, stem);
            }
            throw Unusable(text, "shm:NAME or file:/path/stem");
        }

        public override string ToString()
        {
            return text;
        }

        private static bool IsAbsolute(string path)
        {
            return Segment.OnWindows ? path.Length > 2 && Path.IsPathRooted(path)
                : path.StartsWith("/", StringComparison.Ordinal);
        }

        private static bool IsName(string name)
        {
            const string Letters = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789";
            if (name.Length < 1 || name.Length > 64 || Letters.IndexOf(name[0]) < 0)
                return false;
            foreach (char letter in name)
                if ((Letters + "._-").IndexOf(letter) < 0)
                    return false;
            return true;
        }

        private static ProtocolException Unusable(string text, string expected)
        {
            return new ProtocolException(Farewell.None, "rendezvous: expected " + expected + ", found " + text);
        }
    }

    public sealed class Segment : IDisposable
    {
        public static readonly bool OnWindows = Environment.OSVersion.Platform == PlatformID.Win32NT;

        private readonly string name;
        private readonly FileStream stream; // null for named mappings; keeps the lock, and must stay open for it
        private readonly MemoryMappedFile mapping;
        private readonly MemoryMappedViewAccessor view;
        private readonly IntPtr start;
        private MemoryMappedFile claim; // the lock of a named mapping

        public readonly long Size;

        private Segment(string name, FileStream stream, MemoryMappedFile mapping, MemoryMappedFileAccess access)
        {
            this.name = name;
            this.stream = stream;
            this.mapping = mapping;
            view = mapping.CreateViewAccessor(0, 0, access);
            start = new IntPtr(view.SafeMemoryMappedViewHandle.DangerousGetHandle().ToInt64() + view.PointerOffset);
            Size = stream == null ? view.Capacity : stream.Length;
        }

        // Opens a segment that the agent has created, or returns null while it is not there or has no size yet.
        public static Segment Open(Rendezvous rendezvous, string suffix, bool writable)
        {
            string name = rendezvous.Stem + suffix;
            MemoryMappedFileAccess access =
                writable ? MemoryMappedFileAccess.ReadWrite : MemoryMappedFileAccess.Read;
            FileStream stream = null;
            try
            {
                if (rendezvous.Named)
                {
                    MemoryMappedFileRights rights =
                        writable ? MemoryMappedFileRights.ReadWrite : MemoryMappedFileRights.Read;
                    return new Segment(name, null, MemoryMappedFile.OpenExisting(name, rights), access);
                }
                stream = OpenStream(name);
                long size = stream.Length;
                if (size > 0) // a larger capacity would make the file grow
                    return new Segment(name, stream, MemoryMappedFile.CreateFromFile(
                        stream, null, size, access, HandleInheritability.None, true), access);
            }
            catch (FileNotFoundException)
            {
            }
            catch (DirectoryNotFoundException)
            {
            }
            catch
            {
                if (stream != null)
                    stream.Dispose();
                throw;
            }
            if (stream != null)
                stream.Dispose();
            return null;
        }

        // Whether there is a segment that has not been given a size.
        public static bool IsEmpty(Rendezvous rendezvous, string suffix)
        {
            FileInfo file = rendezvous.Named ? null : new FileInfo(rendezvous.Stem + suffix);
            return file != null && file.Exists && file.Length == 0;
        }

        // Removes it, unless it has a size by now or somebody holds its lock.
        public static void RemoveEmpty(Rendezvous rendezvous, string suffix)
        {
            string name = rendezvous.Stem + suffix;
            try
            {
                using (FileStream file = OpenStream(name))
                {
                    file.Lock(0, 1);
                    if (file.Length == 0)
                        File.Delete(name);
                }
            }
            catch (IOException)
            {
                // gone, or held by an agent that is about to finish it; or Windows, where an open file stays
            }
        }

        // Claims the segment for this process until it is disposed or the process dies; false where it is taken.
        public bool Lock()
        {
            try
            {
                if (stream != null)
                    stream.Lock(0, 1);
                else
                    claim = MemoryMappedFile.CreateNew(name + ".lock", 1);
                return true;
            }
            catch (IOException)
            {
                return false;
            }
        }

        // Claims a dead agent's segment, so that no newer one takes its name until it is removed; false where the name
        // stands for a newer one already, or where another process keeps the lock, which one that is just dead may
        // have for a moment longer.
        public bool LockToRemove(long patienceMs)
        {
            Stopwatch waited = Stopwatch.StartNew();
            bool locked = Lock();
            for (; !locked && waited.ElapsedMilliseconds < patienceMs; locked = Lock())
                Thread.Sleep(5);
            return locked && NameStands();
        }

        public long Read(int offset)
        {
            return Marshal.ReadInt64(start, offset);
        }

        public double ReadDouble(int offset)
        {
            return BitConverter.Int64BitsToDouble(Read(offset));
        }

        // Reads a word that another process publishes; nothing behind it is read before it.
        public long Acquire(int offset)
        {
            long value = Marshal.ReadInt64(start, offset);
            Thread.MemoryBarrier();
            return value;
        }

        public void Write(int offset, long value)
        {
            Marshal.WriteInt64(start, offset, value);
        }

        public void Write(int offset, double value)
        {
            Write(offset, BitConverter.DoubleToInt64Bits(value));
        }

        // Publishes a word: everything written before is visible before it.
        public void Release(int offset, long value)
        {
            Thread.MemoryBarrier();
            Marshal.WriteInt64(start, offset, value);
        }

        // Keeps the order of what is written before it and what is written behind it.
        public void Fence()
        {
            Thread.MemoryBarrier();
        }

        public void Read(int offset, double[] words)
        {
            Marshal.Copy(Place(offset), words, 0, words.Length);
        }

        public void Write(int offset, double[] words)
        {
            Marshal.Copy(words, 0, Place(offset), words.Length);
        }

        public byte[] ReadBytes(int offset, int count)
        {
            byte[] bytes = new byte[count];
            Marshal.Copy(Place(offset), bytes, 0, count);
            return bytes;
        }

        public void WriteBytes(int offset, byte[] bytes)
        {
            Marshal.Copy(bytes, 0, Place(offset), bytes.Length);
        }

        // Reads a padded text; bytes that are no UTF-8 are shown as replacement characters.
        public string ReadText(int offset, int room)
        {
            return Encoding.UTF8.GetString(ReadBytes(offset, room)).TrimEnd('\0');
        }

        // Writes a text padded with zero bytes, cut at a character where it is too long.
        public void WriteText(int offset, int room, string text)
        {
            byte[] bytes = Encoding.UTF8.GetBytes(text);
            int length = Math.Min(bytes.Length, room);
            if (length < bytes.Length)
                while (length > 0 && (bytes[length] & 0xC0) == 0x80)
                    length--;
            Array.Clear(bytes, length, bytes.Length - length);
            Array.Resize(ref bytes, room);
            WriteBytes(offset, bytes);
        }

        // Unmaps; idempotent.
        public void Dispose()
        {
            view.Dispose();
            mapping.Dispose();
            if (claim != null)
                claim.Dispose();
            if (stream != null)
                stream.Dispose();
        }

        // Removes the segment's name if it still stands for this segment, and unmaps.
        public void RemoveAndDispose()
        {
            bool remove = stream != null && NameStands();
            if (OnWindows) // where a file that is open cannot be removed, nor replaced
                Dispose();
            if (remove)
                File.Delete(name);
            Dispose();
        }

        // For writing even where it is only read: a record lock needs that. Shared with its other user.
        private static FileStream OpenStream(string path)
        {
            return new FileStream(path, FileMode.Open, FileAccess.ReadWrite, FileShare.ReadWrite);
        }

        private IntPtr Place(int offset)
        {
            return new IntPtr(start.ToInt64() + offset);
        }

        // Whether the name still stands for what is mapped here: a new agent may have replaced it.
        public bool NameStands()
        {
            if (OnWindows || !File.Exists(name))
                return OnWindows;
            if (!File.Exists("/proc/self/maps"))
                return IsOurSession();
            // The kernel follows the mapped file itself, by device and inode, and shows what became of its name.
            string address = start.ToInt64().ToString("x8") + "-";
            foreach (string line in File.ReadLines("/proc/self/maps"))
                if (line.StartsWith(address, StringComparison.Ordinal))
                    return line.EndsWith("/" + Path.GetFileName(name), StringComparison.Ordinal);
            return false;
        }

        // Without /proc: whether the file of that name carries this segment's session. An unfinished one stays.
        private bool IsOurSession()
        {
            byte[] ours = ReadBytes(Layout.Command.Session, Layout.Command.SessionSize), theirs = new byte[ours.Length];
            using (FileStream file = new FileStream(name, FileMode.Open, FileAccess.Read, FileShare.ReadWrite))
            {
                file.Position = Layout.Command.Session;
                if (file.Read(theirs, 0, theirs.Length) < theirs.Length)
                    return false;
            }
            bool known = false, same = true;
            for (int i = 0; i < ours.Length; i++)
            {
                known |= ours[i] != 0;
                same &= ours[i] == theirs[i];
            }
            return known && same;
        }
    }
}
